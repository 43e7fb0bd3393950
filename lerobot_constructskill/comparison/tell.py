"""Writes a comparison as text for the terminal and as JSON."""

import json
from dataclasses import asdict
from math import inf

from lerobot_constructskill.analysis.report.formats import p_value
from lerobot_constructskill.analysis.stats.comparisons import ALIKE_WITHIN, Conclusion
from lerobot_constructskill.analysis.stats.judgement import Judgement
from lerobot_constructskill.analysis.stats.power import MOST, TARGET
from lerobot_constructskill.comparison.match import MatchedSides
from lerobot_constructskill.comparison.over_tasks import OverTasks
from lerobot_constructskill.errors import plural
from lerobot_constructskill.study.rows import merged

CONCLUSIONS = {
    Conclusion.BETTER: "A is better than B.",
    Conclusion.WORSE: "A is worse than B.",
    Conclusion.ALIKE: f"A and B are alike: they differ by less than {ALIKE_WITHIN * 100:.0f} points.",
    Conclusion.INCONCLUSIVE: "This number of seeds does not show which of them is better.",
}


def tell(matched: MatchedSides | OverTasks, alpha: float) -> str:
    """The whole output, one paragraph for each question of a reader."""
    if isinstance(matched, OverTasks):
        return _over_tasks(matched, alpha)
    judgement = matched.judgement
    unit = _unit(matched)
    paragraphs = (
        _sides(matched, unit),
        _conclusion(matched, alpha, unit),
        _power(judgement, alpha, unit),
        _covered(matched),
        _versions(matched),
    )
    return "\n\n".join(filter(None, paragraphs))


def _over_tasks(over: OverTasks, alpha: float) -> str:
    """The output for several tasks: each in a line, then the mean over tasks of every seed."""
    one = next(iter(over.tasks.values()))
    unit = _unit(one)
    lines = [
        f"{letter}  {name}: {side.kind}" for letter, name, side in zip("AB", over.names, (one.a, one.b), strict=True)
    ]
    lines += [f"at most {_steps(over)}, {one.conditions['obs_type']}", ""]
    starts = {name: _starts(matched) for name, matched in over.tasks.items()}
    wide, wider = (max(24, 2 + max(map(len, texts))) for texts in (starts, starts.values()))
    lines.append(f"{'':{wide}}{'starts':<{wider}}{f'A, mean of {unit}s':<22}B, mean of {unit}s")
    for name, matched in over.tasks.items():
        a, b = (f"{mean.value:.1%}" for mean in (matched.judgement.mean_a, matched.judgement.mean_b))
        lines.append(f"{name:<{wide}}{starts[name]:<{wider}}{a:<22}{b}")
    means = over.judgement.mean_a, over.judgement.mean_b
    shares = [f"{mean.value:.1%} ({mean.low:.0%} to {mean.high:.0%})" for mean in means]
    lines += [f"{'mean over these':<{wide + wider}}{shares[0]:<22}{shares[1]}", ""]
    for letter, names in (("A", over.only_a), ("B", over.only_b)):
        lines += [f"Left out, as {letter} alone has or names it: {', '.join(names)}."] if names else []
    if over.perturbed:
        lines.append(f"Left out, as perturbed: {', '.join(over.perturbed)}; --perturb compares one of these.")
    for letter, rates in (("A", over.rates_a), ("B", over.rates_b)):
        seeds = [getattr(matched, letter.lower()).seeds for matched in over.tasks.values()]
        failed = [" (failed)" if None in of_tasks else "" for of_tasks in zip(*seeds, strict=True)]
        each = [f"{100 * rate:.0f}{said}" for rate, said in zip(rates, failed, strict=True)]
        lines.append(f"{letter}, mean over tasks of each seed, %: {' '.join(each)}")
    told = _conclusion(over, alpha, unit), _power(over.judgement, alpha, unit)
    paragraphs = ("\n".join(lines), *told, _covered(one), _versions(*over.tasks.values()))
    return "\n\n".join(
        [*filter(None, paragraphs), f"Each {unit} counts once; episodes of different tasks are not pooled."]
    )


def _unit(matched: MatchedSides) -> str:
    """What is counted, as a word: a seed or a draw on both sides, or a unit, which is a seed here and a draw there."""
    return matched.a.unit if matched.a.unit == matched.b.unit else "unit"


def _steps(over: OverTasks) -> str:
    lengths = sorted({matched.conditions["episode_length"] for matched in over.tasks.values()})
    return " or ".join(plural(length, "step") for length in lengths)


def as_json(matched: MatchedSides | OverTasks) -> str:
    """Every number as JSON; an estimate is [value, low, high], and infinity, which JSON does not have, is null."""
    values = asdict(matched)
    for one in (values, *values.get("tasks", {}).values()):
        finite = {name: None for name, value in one["judgement"].items() if value == inf}
        one["judgement"] |= finite
    return json.dumps(values, indent=2) + "\n"


def _sides(matched: MatchedSides, unit: str) -> str:
    judgement, where = matched.judgement, matched.conditions
    steps = plural(where["episode_length"], "step")
    lines = [
        f"A  {matched.a.name}: {matched.a.kind}",
        f"B  {matched.b.name}: {matched.b.kind}",
        f"in {where['task']}{where['perturbation']}, at most {steps}, {where['obs_type']}",
        f"starts {_starts(matched)}",
    ]
    sides = {
        "A": (matched.a, judgement.counts_a, judgement.mean_a, matched.rates_a),
        "B": (matched.b, judgement.counts_b, judgement.mean_b, matched.rates_b),
    }
    lines += [
        "",
        f"   {f'{unit}s that placed':<19}{f'episodes placed, mean of {unit}s':<32}each seed, of {matched.episodes}",
    ]
    for letter, (side, counts, mean, rates) in sides.items():
        each = [f"{rate * matched.episodes:.0f}" for rate in rates]
        each = ["failed" if seed is None else number for number, seed in zip(each, side.seeds, strict=True)]
        share = f"{mean.value:.1%} ({mean.low:.0%} to {mean.high:.0%})"
        lines.append(f"{letter}  {f'{counts.met} of {counts.seeds}':<19}{share:<32}{' '.join(each)}")
    return "\n".join(lines)


def _starts(matched: MatchedSides) -> str:
    """Which starts, and how many: "5000 to 5019 (20 of 50 that A or B has)"."""
    starts = matched.starts
    n = f"{len(starts)}"
    n += f", {matched.episodes} a draw" * (matched.episodes < len(starts))
    n += f" of {matched.n_starts} that A or B has" * (matched.n_starts > len(starts))
    return f"{starts[0]} to {starts[-1]} ({n})"


def _conclusion(matched: MatchedSides | OverTasks, alpha: float, unit: str) -> str:
    judgement = matched.judgement
    value, low, high = (100 * share for share in judgement.difference)
    spreads = f"A {100 * judgement.spread_a:.1f}, B {100 * judgement.spread_b:.1f} points"
    interval = f"{100 * (1 - alpha):g} % interval {low:+.0f} to {high:+.0f}"
    return (
        f"{CONCLUSIONS[judgement.conclusion].replace('seeds', f'{unit}s')}\n"
        f"A - B: {value:+.1f} points ({interval}); p = {p_value(judgement.p_value)}, permutation of {unit}s.\n"
        f"{unit.capitalize()}s that placed at least once: "
        f"p = {p_value(judgement.counts_p_value)}, Boschloo's exact test.\n"
        f"Spread over {unit}s: standard deviation {spreads}; p = {p_value(judgement.spread_p_value)}.\n"
        f"{_chance(matched)}"
        f"The interval makes no assumption about how {unit}s vary, so it is wider than the tests suggest."
    )


def _chance(matched: MatchedSides | OverTasks) -> str:
    """How much of the spread is that of single episodes."""
    each = {"A": matched.chance_a, "B": matched.chance_b}
    told = ", ".join(f"{letter} {100 * chance:.1f}" for letter, chance in each.items() if chance is not None)
    return f"Single episodes alone would give {told} points, were all seeds alike.\n" if told else ""


def _power(judgement: Judgement, alpha: float, unit: str) -> str:
    """What so many seeds or draws can and cannot show."""
    a, b = judgement.counts_a.seeds, judgement.counts_b.seeds
    more = f"{'Train' if unit == 'seed' else 'Make'} more {unit}s"
    if max(a, b) == 1:
        return (
            f"One {'training seed' if unit == 'seed' else unit} a side tells how these checkpoints do, and nothing of "
            f"their policies: another {unit} of either may do anything. {more} of both."
        )
    if judgement.smallest_p_value >= alpha:
        return (
            f"{plural(a, unit)} against {b} can show no difference, however large: their p-value is at least "
            f"{judgement.smallest_p_value:.2g}. {more}."
        )
    visible = judgement.visible
    if visible is None:
        return f"{unit.capitalize()}s of neither side vary: how large a difference would be found cannot be told."
    found = "no difference, however large" if visible > 1 else f"a difference of {visible * 100:.0f} points"
    told = f"With this many {unit}s, {TARGET:.0%} of comparisons would find {found}, if {unit}s vary as these do."
    ratio = judgement.visible_spread
    times = "none" if ratio == inf else f"one that is {ratio:g} times the other"
    told += f" Of spreads about one mean, they would find {times}."
    needed = judgement.seeds_needed
    if judgement.conclusion is Conclusion.INCONCLUSIVE and needed is not None:
        number = f"more than {MOST}" if needed == inf else f"about {needed}"
        told += f" To find the difference that was seen, {number} {unit}s a side would be needed."
    return told


def _covered(matched: MatchedSides) -> str:
    """What the intervals are over, and that the sides differ in it or in what they learnt from."""
    a, b = matched.a.covered, matched.b.covered
    learnt = matched.a.learnt_from, matched.b.learnt_from
    units = [f"A unit is a {matched.a.unit} of A and a {matched.b.unit} of B."] if _unit(matched) == "unit" else []
    if a == b:
        told = [f"The intervals hold for {a}."] if a else []
    else:
        covered = {letter: f"{letter}'s interval holds for {one}." for letter, one in (("A", a), ("B", b)) if one}
        missing = [f"What {letter}'s holds for, its files do not say." for letter in "AB" if letter not in covered]
        told = [*covered.values(), *missing]
    differ = all(learnt) and learnt[0] != learnt[1]
    if differ:
        told.append("A and B learnt from different demonstrations.")
    if differ or a != b:
        told.append("Demonstrations can make the difference as well as policies.")
    return " ".join([*units, *told])


def _versions(*each: MatchedSides) -> str:
    """What both sides were made with, and what differs or only one of them says."""
    a, b = merged(matched.a.versions for matched in each), merged(matched.b.versions for matched in each)
    pairs = {name: (a.get(name, "unknown"), b.get(name, "unknown")) for name in dict.fromkeys([*a, *b])}
    same = "; ".join(f"{name} {a}" for name, (a, b) in pairs.items() if a == b)
    different = "; ".join(f"{name} ({a} and {b})" for name, (a, b) in pairs.items() if a != b)
    told = [f"Both were made with {same}." if same else "", f"They differ in {different}." if different else ""]
    return "\n".join(filter(None, told)) or "Neither side says with which versions it was made."
