"""Numbers as a report writes them. Every function takes numbers and gives plain text."""

from collections.abc import Sequence

from lerobot_constructskill.analysis.stats.correlation import Correlation
from lerobot_constructskill.analysis.stats.intervals import Estimate
from lerobot_constructskill.errors import plural


def percent(share: float) -> str:
    """0.354 -> "35 %"."""
    return f"{100 * share:.0f} %"


def rare(p: float) -> str:
    """A probability in per cent that is never printed as nothing."""
    return "< 1 %" if p < 0.01 else percent(p)


def points(difference: float) -> str:
    """A difference of shares in percentage points, signed: 0.2 -> "+20"."""
    return signed(100 * difference, 0)


def signed(value: float, digits: int) -> str:
    text = f"{value:+.{digits}f}"
    if float(text) == 0:
        return f"{0:.{digits}f}"
    return text.replace("-", "−")


def p_value(p: float) -> str:
    """As journals print it: "0.0031", "0.042", "0.65", "< 0.0001"."""
    if p < 1e-4:
        return "< 0.0001"
    if p < 0.01:
        return f"{p:.4f}"
    return f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def chance(p: float) -> str:
    """A probability that is never printed as certain."""
    return "> 0.99" if p > 0.99 else "< 0.01" if p < 0.01 else f"{p:.2f}"


def mean_episodes(estimate: Estimate, episodes: int) -> str:
    """Mean episodes of a run, of `episodes`: "6.1"."""
    return f"{estimate.value * episodes:.1f}"


def episodes_range(estimate: Estimate, episodes: int) -> str:
    return f"{estimate.low * episodes:.1f}–{estimate.high * episodes:.1f}"


def share_range(estimate: Estimate) -> str:
    """Bounds in per cent: "35–93 %"."""
    return f"{100 * estimate.low:.0f}–{100 * estimate.high:.0f} %"


def points_range(estimate: Estimate) -> str:
    return f"{points(estimate.low)} to {points(estimate.high)}"


def error_range(estimate: Estimate | None) -> str:
    """Held-out error in 1e-4 m2, mean [range], as in the paper's tables."""
    if estimate is None:
        return "–"
    value, low, high = (1e4 * number for number in estimate)
    return f"{value:.2f} [{low:.2f}–{high:.2f}]"


def tau(correlation: Correlation) -> str:
    """Kendall's tau with its p-value, in running text."""
    p = p_value(correlation.p_value)
    return f"Kendall's τ {signed(correlation.tau.value, 2)}, p {p if p.startswith('<') else f'= {p}'}"


def episodes(share: float, n: int) -> str:
    return f"{share * n:.3g} of {plural(n, 'episode')}"


def seeds(n: int) -> str:
    return plural(n, "seed")


def seed_spans(spans: Sequence[tuple[int, int]]) -> str:
    """ "seed 0", "seeds 0–9", "seeds 0–9 and 100–109"."""
    noun = "seed" if len(spans) == 1 and spans[0][0] == spans[0][1] else "seeds"
    return f"{noun} {listed([str(first) if first == last else f'{first}–{last}' for first, last in spans])}"


def quoted(label: str) -> str:
    """A label as it stands in a sentence: in quotation marks where it has a comma of its own."""
    return f"“{label}”" if "," in label else label


def listed(items: Sequence[str]) -> str:
    """ "a, b and c"."""
    return " and ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else items)


def roman(number: int) -> str:
    """Table numbers, as the paper writes them."""
    text = ""
    for value, sign in ((50, "L"), (40, "XL"), (10, "X"), (9, "IX"), (5, "V"), (4, "IV"), (1, "I")):
        while number >= value:
            text, number = text + sign, number - value
    return text
