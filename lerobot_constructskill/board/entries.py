"""The board's entries: submissions, how far each was verified, and what their seeds reached in every setting."""

from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_constructskill.analysis.stats.intervals import Estimate, mean_rate
from lerobot_constructskill.analysis.stats.walls import over_seeds
from lerobot_constructskill.board.copies import near_copy
from lerobot_constructskill.board.declaration import NAME, Declaration
from lerobot_constructskill.board.protocol import CLAIMED, RANKED_FROM, TRAINING_SEEDS, PublicValue
from lerobot_constructskill.board.recovered import Recovery, path_of, read_recovered
from lerobot_constructskill.board.rerun import check_later
from lerobot_constructskill.board.submission import SCORES, Claim, Submission, read_submission
from lerobot_constructskill.board.verification import different, read_verification
from lerobot_constructskill.contract import get_task
from lerobot_constructskill.errors import InputError, MissingError
from lerobot_constructskill.plans.plan import read_plan

ENTRIES, VERIFIED = "entries", "verified"
"""Folders of a board: what anybody submits, and what its keepers found when they verified it."""


@dataclass(frozen=True)
class Laid:
    """What an entry laid of a plan. Means are over training seeds, then over a seed's episodes, failed ones included.

    Args:
        elements: of the plan.
        chain: elements that lie in their places before the first that does not: mean, least and most of a seed.
        share: of the elements that lie in their places at the end, in [0, 1]: the same.
        drops, knocks, collisions: how often in all episodes, as of `recording.Episode`.
    """

    elements: int
    chain: Estimate
    share: Estimate
    drops: int
    knocks: int
    collisions: int


@dataclass(frozen=True)
class Standing:
    """Result of an entry in one setting.

    Args:
        claims: its episodes there, by training seed.
        placed, lifted: mean over training seeds of the share of episodes, with its interval over seeds.
        errors: episodes that failed with an error; they count as neither.
        laid: what it laid; None where the task is no plan, or the entry is from before this was counted.
    """

    claims: dict[int, list[Claim]]
    placed: Estimate
    lifted: Estimate
    errors: int
    laid: Laid | None


@dataclass(frozen=True, eq=False)
class Entry:
    """A line of the board.

    Args:
        name: of its folder; its permalink.
        submission: as it was opened.
        level: one of `protocol.LEVELS`.
        verdict: result of its verification; empty if it was not verified.
        recoveries: where its failed episodes were lost, by setting, training seed and start; empty if unknown.
        recoveries_are_current: whether this code would find the same.
    """

    name: str
    submission: Submission
    level: str
    verdict: dict[str, Any]
    recoveries: dict[tuple[str, int, int], Recovery]
    recoveries_are_current: bool

    @property
    def declaration(self) -> Declaration:
        return self.submission.declaration

    @property
    def is_reference(self) -> bool:
        """Whether it is a floor or a ceiling, which has no rank and lacks no seeds."""
        return not self.declaration.about.is_policy

    @property
    def is_ranked(self) -> bool:
        is_checked = self.level != CLAIMED and self.declaration.is_replayable
        return is_checked and not self.is_reference and len(self.declaration.training_seeds) >= RANKED_FROM

    @property
    def other_versions(self) -> list[str]:
        """What it was made with, where its replay had something else."""
        made = different(self.declaration.versions, self.verdict.get("versions", {}))
        return [f"{name} {there}, verified with {here}" for name, (there, here) in made.items()]

    @property
    def rerun_value(self) -> PublicValue | None:
        """The public value that the starts of its re-run came from."""
        return PublicValue.of(self.verdict["rerun"]["value"]) if "rerun" in self.verdict else None

    @property
    def failures(self) -> list[Claim]:
        """Its episodes that can be searched: executed, not placed, of a policy, with physics that can be replayed."""
        if not self.declaration.is_replayable or self.is_reference:
            return []
        claims = [one for one in self.submission.claims if one.error is None and not one.placed]
        return sorted(claims, key=lambda claim: claim.key)

    @property
    def missing_seeds(self) -> int:
        """How many of the protocol's training seeds it lacks."""
        return 0 if self.is_reference else len({*TRAINING_SEEDS} - {*self.declaration.training_seeds})

    @cached_property
    def standings(self) -> dict[str, Standing]:
        """What it reached in each of its settings, by name."""
        return {name: self._standing(name) for name in self.declaration.settings}

    def _standing(self, setting: str) -> Standing:
        there = sorted((one for one in self.submission.claims if one.setting == setting), key=lambda one: one.key)
        claims = {seed: list(own) for seed, own in groupby(there, key=lambda one: one.training_seed)}
        placed, lifted = (
            mean_rate(np.array([np.mean([getattr(one, of) for one in own]) for own in claims.values()]))
            for of in ("placed", "lifted")
        )
        errors = sum(one.error is not None for one in there)
        plan = get_task(self.declaration.settings[setting].task).plan
        laid = _laid(claims, len(read_plan(plan).elements)) if plan else None
        return Standing(claims, placed, lifted, errors, laid)


def _laid(claims: dict[int, list[Claim]], elements: int) -> Laid | None:
    """What the episodes of each seed laid of a plan of so many elements; None where one does not tell."""
    every = [claim for own in claims.values() for claim in own]
    if any(claim.error is None and getattr(claim, name) is None for claim in every for name in SCORES):
        return None
    counts = {name: [getattr(claim, name) or 0 for claim in every] for name in SCORES}
    seeds = [claim.training_seed for claim in every]
    return Laid(
        elements,
        over_seeds(counts["chain"], seeds),
        over_seeds([count / elements for count in counts["placements"]], seeds),
        **{name: sum(counts[name]) for name in ("drops", "knocks", "collisions")},
    )


def read_entries(root: Path) -> tuple[list[Entry], list[str]]:
    """Read every entry of a board's folder.

    Returns:
        The entries in the order of their names, and a sentence for each entry that cannot be read.

    Raises:
        MissingError: there is no such folder.
        InputError: the board's verdicts are no folder.
    """
    if not (root / ENTRIES).is_dir():
        raise MissingError(f"'{root}' is not a board: it has no folder '{ENTRIES}'.")
    if (root / VERIFIED).exists() and not (root / VERIFIED).is_dir():
        raise InputError(f"'{root / VERIFIED}' is not a folder of verdicts.")
    entries, refused = [], []
    for path in sorted((root / ENTRIES).iterdir()):
        if path.suffix != ".partial":  # an entry is being written, or was when its process was killed
            try:
                entries.append(_entry(root, path))
            except (InputError, MissingError) as error:
                refused.append(f"Entry {path.name!a}: {error}")
    entries, copies = _without_copies(entries)
    return entries, refused + copies


def check_original(path: Path) -> None:
    """Refuse a submission that lies in a board's folder and repeats another entry, or nearly.

    Raises:
        InputError: it does, and the other one was verified before it.
    """
    path = path.resolve()
    if path.parent.name == ENTRIES:
        said = f"Entry {path.name!a}: "
        refused = [one.removeprefix(said) for one in read_entries(path.parents[1])[1] if one.startswith(said)]
        if refused:
            raise InputError(refused[0])


def _without_copies(entries: list[Entry]) -> tuple[list[Entry], list[str]]:
    """Entries without those that repeat one that was verified before them, and a sentence for each of these."""
    kept: list[Entry] = []
    refused = []
    for entry in sorted(entries, key=lambda one: (one.level == CLAIMED, one.verdict.get("date", ""), one.name)):
        if said := next(filter(None, (_repeated(entry, other) for other in kept)), None):
            refused.append(f"Entry {entry.name!a}: {said}")
        else:
            kept.append(entry)
    return sorted(kept, key=lambda one: one.name), refused


def _repeated(entry: Entry, other: Entry) -> str | None:
    """What an entry has of another one, as a sentence; None where it has nothing of it.

    Whoever submits a policy to two suites may have the same episodes in both, of the same training seeds.
    """
    if entry.submission.sha256 == other.submission.sha256:
        return f"it is the entry {other.name} under another name."
    if entry.is_reference and other.is_reference:
        return None
    mine, theirs = entry.declaration, other.declaration
    is_twice = mine.about.submitter == theirs.about.submitter and mine.suite != theirs.suite
    pair = near_copy(
        entry.submission.claims,
        other.submission.claims,
        lambda one, there: is_twice and one.training_seed == there.training_seed,
    )
    return pair and f"{pair[0].label} has the actions of the entry {other.name}, {pair[1].label}, or nearly."


def _entry(root: Path, path: Path) -> Entry:
    if not NAME.allows(path.name):
        raise InputError(f"the folder of an entry must be called by {NAME.meaning}.")
    submission = read_submission(path)
    verdict = read_verification(root / VERIFIED / f"{path.name}.json", submission.sha256)
    if "rerun" in verdict:
        check_later(PublicValue.of(verdict["rerun"]["value"]), str(verdict["date"]))
    recovered = read_recovered(path_of(root, path.name), submission.sha256)
    return Entry(path.name, submission, verdict.get("level", CLAIMED), verdict, *recovered)


def ranks(entries: list[Entry], setting: str) -> dict[str, tuple[int, bool]]:
    """Rank of each entry that has one in a setting, and whether it is shared.

    Only entries of one class that were evaluated alike are compared: a custom entry names its settings. Those of which
    each seed learnt from a draw of its own are compared with each other alone. An entry is
    behind those whose interval over seeds lies wholly above its own, so an entry that no seeds put behind another has
    rank 1. Two intervals that overlap can have different ranks: a third may lie above one of them alone.
    """
    alike: dict[tuple, dict[str, Estimate]] = {}
    for entry in entries:
        if entry.is_ranked and setting in entry.standings:
            said = entry.declaration
            kind = said.settings_class, said.settings[setting].compared, said.about.demonstrations == "own"
            alike.setdefault(kind, {})[entry.name] = entry.standings[setting].placed
    found = {}
    for placed in alike.values():
        rank = {name: 1 + sum(other.low > own.high for other in placed.values()) for name, own in placed.items()}
        found |= {name: (own, list(rank.values()).count(own) > 1) for name, own in rank.items()}
    return found
