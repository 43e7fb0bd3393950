"""A comparison as text for the terminal, and as plain values for a file."""

import json
from dataclasses import asdict
from math import inf, isfinite
from typing import Any

from lerobot_constructskill.analysis.stats.comparisons import ALIKE_WITHIN, Verdict
from lerobot_constructskill.analysis.stats.intervals import Estimate
from lerobot_constructskill.analysis.stats.judgement import Judgement
from lerobot_constructskill.analysis.stats.outcomes import Counts
from lerobot_constructskill.analysis.stats.power import MOST, TARGET
from lerobot_constructskill.comparison.match import Comparison, tell_starts
from lerobot_constructskill.comparison.sides import Side
from lerobot_constructskill.errors import plural

VERDICTS = {
    Verdict.BETTER: "A is better than B.",
    Verdict.WORSE: "A is worse than B.",
    Verdict.ALIKE: f"A and B are alike: they differ by less than {ALIKE_WITHIN * 100:.0f} points.",
    Verdict.INCONCLUSIVE: "This number of seeds does not show which of them is better.",
}


def tell(comparison: Comparison, alpha: float) -> str:
    """The whole output, one paragraph for each question that a reader has."""
    return "\n\n".join(
        [
            _sides(comparison),
            _table(comparison),
            _verdict(comparison.judgement, alpha),
            _power(comparison.judgement, alpha),
            _versions(comparison.a, comparison.b),
        ]
    )


def as_json(comparison: Comparison) -> str:
    """Every number as JSON; infinity, which JSON does not have, is null."""
    values = asdict(comparison) | {"judgement": _plain(comparison.judgement)}
    return json.dumps(values, indent=2) + "\n"


def _plain(value: Any) -> Any:
    if hasattr(value, "_asdict"):
        return {name: _plain(one) for name, one in value._asdict().items()}
    return None if isinstance(value, float) and not isfinite(value) else value


def _sides(comparison: Comparison) -> str:
    lines = [f"{letter}  {side.name}: {side.kind}" for letter, side in (("A", comparison.a), ("B", comparison.b))]
    n = f"{len(comparison.starts)}"
    if comparison.n_starts > len(comparison.starts):
        n += f" of {comparison.n_starts} that A or B has"
    lines.append(f"in {comparison.conditions}; {tell_starts(comparison.starts)} ({n})")
    for letter, side in (("A", comparison.a), ("B", comparison.b)):
        if side.env is None:
            lines.append(f"lerobot-eval does not write where it evaluated: {letter} is taken to be from there")
    return "\n".join(lines)


def _table(comparison: Comparison) -> str:
    judgement, n = comparison.judgement, len(comparison.starts)
    head = f"   {'seeds that placed':<19}{'episodes placed, mean of seeds':<32}each seed, of {n}"
    rows = (
        ("A", judgement.counts_a, judgement.mean_a, comparison.rates_a, comparison.a),
        ("B", judgement.counts_b, judgement.mean_b, comparison.rates_b, comparison.b),
    )
    return "\n".join([head, *(_row(*row, n) for row in rows)])


def _row(letter: str, counts: Counts, mean: Estimate, rates: list[float], side: Side, n: int) -> str:
    each = ["failed" if seed is None else f"{rate * n:.0f}" for rate, seed in zip(rates, side.seeds, strict=True)]
    share = f"{mean.value:.1%} ({mean.low:.0%} to {mean.high:.0%})"
    return f"{letter}  {f'{counts.met} of {counts.seeds}':<19}{share:<32}{' '.join(each)}"


def _verdict(judgement: Judgement, alpha: float) -> str:
    apart = judgement.difference
    interval = f"{100 * (1 - alpha):g} % interval {apart.low * 100:+.0f} to {apart.high * 100:+.0f}"
    return (
        f"{VERDICTS[judgement.verdict]}\n"
        f"A - B: {apart.value * 100:+.1f} points ({interval}); p = {_p(judgement.p_value)}, permutation of seeds.\n"
        f"Seeds that placed at least once: p = {_p(judgement.counts_p_value)}, Boschloo's exact test.\n"
        "The interval makes no assumption about how seeds vary, so it is wider than the tests suggest."
    )


def _p(value: float) -> str:
    return f"{value:.4f}" if value < 0.01 else f"{value:.2f}"


def _power(judgement: Judgement, alpha: float) -> str:
    """What so many seeds can and cannot show."""
    a, b = judgement.counts_a.seeds, judgement.counts_b.seeds
    if max(a, b) == 1:
        return (
            "One training seed a side tells how these two checkpoints do, and nothing of their policies: another seed "
            "of either may do anything. Train more seeds of both."
        )
    if judgement.smallest_p_value >= alpha:
        return (
            f"{plural(a, 'seed')} against {b} can show no difference, however large: their p-value is at least "
            f"{judgement.smallest_p_value:.2g}. Train more seeds."
        )
    visible = [(judgement.visible_at_worst, "if each seed places always or never")]
    if judgement.visible is not None:
        visible.insert(0, (judgement.visible, "if seeds vary as these do"))
    told = "; ".join(f"{_points(difference)}, {condition}" for difference, condition in visible)
    return " ".join([f"With this many seeds, {TARGET:.0%} of comparisons would find: {told}.", *_needed(judgement)])


def _points(difference: float | None) -> str:
    if not difference or difference > 1:
        return "no difference, however large"
    return f"a difference of {difference * 100:.0f} points"


def _needed(judgement: Judgement) -> list[str]:
    needed = judgement.seeds_needed
    if judgement.verdict is not Verdict.INCONCLUSIVE or needed is None:
        return []
    number = f"more than {MOST}" if needed == inf else f"about {needed}"
    return [f"To find the difference that was seen, {number} seeds a side would be needed."]


def _versions(a: Side, b: Side) -> str:
    """What both sides were made with, what differs, and what only one of them tells."""
    shared = [name for name in a.versions if name in b.versions]
    same = {name: a.versions[name] for name in shared if a.versions[name] == b.versions[name]}
    different = {name: f"({a.versions[name]} and {b.versions[name]})" for name in shared if name not in same}
    only_a, only_b = ({n: v for n, v in side.versions.items() if n not in shared} for side in (a, b))
    lines = {
        "Both were made with": same,
        "They differ in": different,
        "Only A says": only_a,
        "Only B says": only_b,
    }
    told = [f"{what} {_listed(named)}." for what, named in lines.items() if named]
    return "\n".join(told) or "Neither side says with which versions it was made."


def _listed(versions: dict[str, str]) -> str:
    return "; ".join(f"{name} {version}" for name, version in versions.items())
