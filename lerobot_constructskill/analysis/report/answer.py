"""What a study says, in sentences made from its findings: the paragraph at the top of a report."""

from lerobot_constructskill.analysis.report.findings import Findings, Line, SettingFindings
from lerobot_constructskill.analysis.report.wording import episodes, listed, quoted, seeds, share_range, tau
from lerobot_constructskill.analysis.stats.comparisons import Comparison, Verdict
from lerobot_constructskill.analysis.stats.intervals import Estimate
from lerobot_constructskill.analysis.stats.outcomes import Counts
from lerobot_constructskill.errors import plural
from lerobot_constructskill.study.rows import SIGHTLESS

SOLVED = 0.9
"""Share of episodes from which on a reference counts as solving a setting."""


def answer(findings: Findings) -> list[tuple[str, str]]:
    """(setting's label, its paragraph) for every setting with a section of its own."""
    return [(setting.label, _paragraph(setting, findings.episodes, findings.alpha)) for setting in findings.sections]


def status(findings: Findings) -> str | None:
    """What is missing or failed, one sentence or two; None where nothing is."""
    sentences = []
    if findings.missing:
        verb = "is" if findings.missing == 1 else "are"
        runs = f"{findings.missing} of {plural(findings.planned, 'run')}"
        sentences.append(f"{runs} {verb} missing: every number below is provisional.")
    if findings.missing_references:
        names = listed([f"{label} ({setting})" for setting, label in findings.missing_references])
        sentences.append(f"References without a result: {names}.")
    failed = sum(setting.failed_seeds for setting in findings.settings)
    if failed:
        count = "counts as a seed" if failed == 1 else "count as seeds"
        sentences.append(f"{plural(failed, 'run')} failed and {count} that met no criterion.")
    absent = [
        (setting, line)
        for setting in findings.settings
        for line in setting.everything
        if line.failed and not line.outcomes
    ]
    unavailable = dict.fromkeys(line.label for _, line in absent if line.lacks_weights)
    if unavailable:
        sentences.append(f"Weights not available: {listed(list(unavailable))}.")
    sentences += [
        f"No run of {line.label} ({setting.label}) finished." for setting, line in absent if not line.lacks_weights
    ]
    return " ".join(sentences) or None


def _paragraph(setting: SettingFindings, n_episodes: int, alpha: float) -> str:
    lines = [line for line in setting.lines if line.outcomes]
    if not lines:
        return "No run has finished."
    sentences = [
        _best(lines, n_episodes),
        _verdicts(setting, "lifted", "Lifting"),
        _verdicts(setting, "placed", "Placing"),
        _shares(setting, alpha),
        _offline_error(setting, alpha),
        _sightless(setting, n_episodes),
    ]
    return " ".join(sentence for sentence in sentences if sentence)


def _best(lines: list[Line], n_episodes: int) -> str:
    """Who placed most among those with most seeds, who did better with fewer, and how often it was lifted at best."""
    most_seeds = max(line.seeds for line in lines)
    rivals = [line for line in lines if line.seeds == most_seeds]
    top, best = _top(rivals)
    rank = f", the most of {len(rivals)} variants with {seeds(most_seeds)}" if len(rivals) > len(best) else ""
    first = f"{_placed_in(best)}, in {episodes(top, n_episodes)} on average{rank}"
    if top == 0:
        first = f"no variant{f' with {seeds(most_seeds)}' * (len(rivals) < len(lines))} placed the object"
    parts = [first]
    if fewer := [line for line in lines if line.seeds < most_seeds and line.outcomes["placed"].mean.value > top]:
        share, better = _top(fewer)
        parts.append(f"with fewer seeds, {_placed_in(better)}, in {episodes(share, n_episodes)} on average")
    return f"{'; '.join([*parts, _lifts(lines)])}."


def _top(lines: list[Line]) -> tuple[float, list[Line]]:
    """The largest mean share of episodes placed, and whose it is."""
    top = max(line.outcomes["placed"].mean.value for line in lines)
    return top, [line for line in lines if line.outcomes["placed"].mean.value == top]


def _placed_in(lines: list[Line]) -> str:
    """In how many seeds each placed; lines with equally many are named together."""
    alike: dict[tuple[Counts, Estimate], list[str]] = {}
    for line in lines:
        placed = line.outcomes["placed"]
        alike.setdefault((placed.counts, placed.exact), []).append(quoted(line.label))
    return ", ".join(
        f"{listed(labels)} placed the object in {counts.met} of {seeds(counts.seeds)}{' each' * (len(labels) > 1)} "
        f"(95 % interval {share_range(exact)})"
        for (counts, exact), labels in alike.items()
    )


def _lifts(lines: list[Line]) -> str:
    """The largest share of seeds that lifted at least once, and whose it is."""
    top = max(line.outcomes["lifted"].counts.rate for line in lines)
    if top == 0:
        return "none lifted it"
    alike: dict[Counts, list[str]] = {}
    for line in lines:
        counts = line.outcomes["lifted"].counts
        if counts.rate == top:
            alike.setdefault(counts, []).append(quoted(line.label))
    named = {
        counts: listed(labels) if len(labels) < 4 else f"{len(labels)} variants" for counts, labels in alike.items()
    }
    shares = [f"in {counts.met} of {seeds(counts.seeds)} by {labels}" for counts, labels in named.items()]
    return f"at best it was lifted at least once {listed(shares)}"


def _verdicts(setting: SettingFindings, criterion: str, noun: str) -> str:
    comparisons = setting.comparisons[criterion]
    if not comparisons:
        return ""
    decided = [_ordered(pair) for pair in comparisons if pair.verdict in (Verdict.BETTER, Verdict.WORSE)]
    alike = sum(pair.verdict is Verdict.ALIKE for pair in comparisons)
    undecided = len(comparisons) - len(decided) - alike
    parts = [_beats(decided, setting)] if decided else []
    if alike:
        parts.append(f"{plural(alike, 'pair')} {'is' if alike == 1 else 'are'} alike within 20 points")
    if undecided:
        share = f"{undecided} of " if undecided < len(comparisons) else "all " if undecided > 1 else "the "
        verb = "is" if undecided == 1 else "are"
        number = "" if share == "the " else f"{len(comparisons)} "
        noun_form = "comparison" if len(comparisons) == 1 else "comparisons"
        parts.append(
            f"{share}{number}declared {noun_form}{_of_those_made(setting, comparisons)} {verb} {Verdict.INCONCLUSIVE}"
        )
    return f"{noun}: {'; '.join(parts)}."


def _of_those_made(setting: SettingFindings, comparisons: list[Comparison]) -> str:
    missing = setting.declared - len(comparisons)
    return f" that can be made ({missing} more cannot)" if missing else ""


def _ordered(pair: Comparison) -> tuple[str, str]:
    return (pair.a, pair.b) if pair.verdict is Verdict.BETTER else (pair.b, pair.a)


def _beats(pairs: list[tuple[str, str]], setting: SettingFindings) -> str:
    """ "a beats b and c; d beats c"."""
    losers: dict[str, list[str]] = {}
    for winner, loser in pairs:
        losers.setdefault(winner, []).append(quoted(setting.labels[loser]))
    return "; ".join(f"{quoted(setting.labels[winner])} beats {listed(beaten)}" for winner, beaten in losers.items())


def _shares(setting: SettingFindings, alpha: float) -> str:
    """By share of episodes, where seeds are not all-or-nothing and "at least once" says little."""
    tests = [test for test in setting.rate_tests["placed"] if test.mean_holm < alpha]
    if setting.all_or_nothing or not setting.rate_tests["placed"]:
        return ""
    pairs = [(test.a, test.b) if test.mean > 0 else (test.b, test.a) for test in tests]
    found = _beats(pairs, setting) if pairs else "no pair can be told apart"
    return f"Seeds succeed in some of their episodes here; by mean episodes placed, {found}."


def _offline_error(setting: SettingFindings, alpha: float) -> str:
    correlation = setting.correlations["placed"][0][1]
    if correlation is None:
        return ""
    if correlation.p_value >= alpha:
        return f"Held-out error does not show which seeds of a variant place ({tau(correlation)}, not corrected)."
    direction = "lower" if correlation.tau.value < 0 else "higher"
    return f"A variant's seeds with {direction} held-out error place more often ({tau(correlation)}, not corrected)."


def _sightless(setting: SettingFindings, n_episodes: int) -> str:
    sightless = [line for line in setting.references if line.role == SIGHTLESS and line.outcomes]
    placed = [(line.label, line.outcomes["placed"].mean.value) for line in sightless]
    solving = [
        f"{quoted(label)} places in {episodes(share, n_episodes)}" for label, share in placed if share >= SOLVED
    ]
    if not solving:
        return ""
    return f"{listed(solving)} without looking at the scene, so success here does not show that a policy sees."
