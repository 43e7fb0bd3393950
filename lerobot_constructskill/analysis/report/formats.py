"""Numbers as a report prints them. Every function returns plain text."""

from math import inf

from lerobot_constructskill.analysis.stats.intervals import Estimate


def percent(share: float) -> str:
    """0.354 -> "35 %"."""
    return f"{100 * share:.0f} %"


def share_range(estimate: Estimate) -> str:
    """Bounds in per cent: "35–93 %"."""
    return f"{100 * estimate.low:.0f}–{100 * estimate.high:.0f} %"


def signed(value: float, digits: int) -> str:
    """A number with its sign, except for zero: "+0.20", "−0.20", "0.00"."""
    text = f"{value:+.{digits}f}"
    return f"{0:.{digits}f}" if float(text) == 0 else text.replace("-", "−")


def signed_range(estimate: Estimate, digits: int) -> str:
    """Bounds with their signs: "−0.83 to 0.20"."""
    return f"{signed(estimate.low, digits)} to {signed(estimate.high, digits)}"


def points(difference: float) -> str:
    """A difference of shares in percentage points: 0.2 -> "+20"."""
    return signed(100 * difference, 0)


def points_range(estimate: Estimate) -> str:
    """Bounds in percentage points: "−83 to +20"."""
    return f"{points(estimate.low)} to {points(estimate.high)}"


def deviation(estimate: Estimate) -> str:
    """A standard deviation of shares in points: "6.1 (3.2–11.4)", or "0.4 (not determined)": none is above 0.5."""
    value, low, high = (f"{100 * share:.1f}" for share in estimate)
    return f"{value} ({low}–{high})" if estimate.high <= 0.5 else f"{value} (not determined)"


def in_points(share: float | None) -> str:
    """A share in points: 0.061 -> "6.1"; "–" for None."""
    return "–" if share is None else f"{100 * share:.1f}"


def times(ratio: float) -> str:
    """How many times as large: 2.5 -> "2.5 times"; "none" for infinity."""
    return "none" if ratio == inf else f"{ratio:g} times"


def p_value(p: float) -> str:
    """A p-value as journals print it: "0.0031", "0.042", "0.65", "< 0.0001"."""
    if p < 1e-4:
        return "< 0.0001"
    digits = 4 if p < 0.01 else 3 if p < 0.1 else 2
    return f"{p:.{digits}f}"


def chance(p: float) -> str:
    """A probability that is never printed as certain: "0.76", "< 0.01", "> 0.99"."""
    return "> 0.99" if p > 0.99 else "< 0.01" if p < 0.01 else f"{p:.2f}"


def mean_episodes(estimate: Estimate, episodes: int) -> str:
    """Mean episodes of a run, of `episodes`, with the interval: "6.1 (3.6–7.3)"."""
    value, low, high = (f"{episodes * share:.1f}" for share in estimate)
    return f"{value} ({low}–{high})"


def error_range(estimate: Estimate | None) -> str:
    """Held-out error in 1e-4 m2 as mean [range], as in the paper's tables."""
    if estimate is None:
        return "–"
    value, low, high = (f"{1e4 * error:.2f}" for error in estimate)
    return f"{value} [{low}–{high}]"


def millimetres(value: float | None) -> str:
    """A length in mm: "1.4"."""
    return "–" if value is None else f"{value:.1f}"


def whole(value: float | None) -> str:
    """A number without decimals: "14"."""
    return "–" if value is None else f"{value:.0f}"
