"""The board's entries: submissions, what is known of each, and what their seeds reached in every setting."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_constructskill.analysis.stats.intervals import Estimate
from lerobot_constructskill.analysis.stats.spread import mean_rate
from lerobot_constructskill.board.protocol import CLAIMED, LEVELS, RANKED_FROM, TRAINING_SEEDS
from lerobot_constructskill.board.submission import (
    NAME,
    Claim,
    Declaration,
    Submission,
    is_replayable,
    read_submission,
)
from lerobot_constructskill.contract import OBS_TYPES
from lerobot_constructskill.errors import InputError, MissingError

ENTRIES, VERIFIED = "entries", "verified"
"""Folders of a board: what strangers submit, and what its keepers found when they verified it."""


@dataclass(frozen=True)
class Standing:
    """What an entry reached in one setting.

    Args:
        claims: its episodes there, by training seed.
        placed, lifted: mean over training seeds of the share of episodes, with its interval over seeds.
        errors: episodes that failed with an error; they count as neither.
    """

    claims: dict[int, list[Claim]]
    placed: Estimate
    lifted: Estimate
    errors: int


@dataclass(frozen=True, eq=False)
class Entry:
    """A line of the board.

    Args:
        name: of its folder; its permalink.
        submission: as it was opened.
        level: one of `protocol.LEVELS`.
        verdict: what its verification found; empty where nobody verified it.
    """

    name: str
    submission: Submission
    level: str
    verdict: dict[str, Any]

    @property
    def said(self) -> Declaration:
        return self.submission.declaration

    @property
    def is_reference(self) -> bool:
        """Whether it is a floor or a ceiling: it does not see what a policy sees, has no rank and misses no seeds."""
        return self.said.about.observes not in OBS_TYPES

    @property
    def is_ranked(self) -> bool:
        enough = len(self.said.training_seeds) >= RANKED_FROM
        return not self.is_reference and enough and self.level != CLAIMED and is_replayable(self.said)

    @property
    def missing_seeds(self) -> int:
        """How many of the protocol's training seeds it lacks."""
        return 0 if self.is_reference else len({*TRAINING_SEEDS} - {*self.said.training_seeds})

    @cached_property
    def standings(self) -> dict[str, Standing]:
        return {name: self._standing(name) for name in self.said.settings}

    def _standing(self, setting: str) -> Standing:
        claims = {seed: [] for seed in sorted(self.said.training_seeds)}
        for claim in sorted(self.submission.claims, key=lambda claim: claim.key):
            if claim.setting == setting:
                claims[claim.training_seed].append(claim)
        placed, lifted = (
            mean_rate(np.array([np.mean([getattr(one, of) for one in own]) for own in claims.values()]))
            for of in ("placed", "lifted")
        )
        return Standing(claims, placed, lifted, sum(one.error is not None for own in claims.values() for one in own))


def read_entries(root: Path) -> list[Entry]:
    """Every entry of a board's folder, by name.

    Raises:
        MissingError: there is no such folder.
        InputError: an entry is no submission; the message names it.
    """
    if not (root / ENTRIES).is_dir():
        raise MissingError(f"'{root}' is not a board: it has no folder '{ENTRIES}'.")
    # What ends in .partial is being written, or was when its process was killed.
    return [_entry(root, path) for path in sorted((root / ENTRIES).iterdir()) if path.suffix != ".partial"]


def _entry(root: Path, path: Path) -> Entry:
    if not NAME.allows(path.name):
        raise InputError(f"The folder of an entry must be called by {NAME.meaning}, not {path.name!a}.")
    try:
        submission = read_submission(path)
    except (InputError, MissingError) as error:
        raise type(error)(f"Entry '{path.name}': {error}") from error
    verdict = read_verdict(root / VERIFIED / f"{path.name}.json", {"submission": submission.sha256})
    return Entry(path.name, submission, verdict.get("level", CLAIMED), verdict)


def read_verdict(path: Path, of: Mapping[str, Any]) -> dict[str, Any]:
    """What was found and recorded in a file, if it says what `of` says; empty otherwise.

    Raises:
        InputError: the file is no verdict.
    """
    if not path.is_file():
        return {}
    try:
        verdict = {"machines": []} | json.loads(path.read_text())  # before 2026-11-24 none was named
        known = verdict["level"] in LEVELS and isinstance(verdict["versions"], dict)
        known = known and isinstance(verdict["machines"], list) and isinstance(verdict["date"], str)
    except (ValueError, KeyError, TypeError):
        known = False
    if not known:
        raise InputError(f"'{path}' is not a verdict of constructskill-verify.")
    return verdict if all(verdict.get(name) == value for name, value in of.items()) else {}


def ranks(entries: list[Entry], setting: str) -> dict[str, tuple[int, bool]]:
    """Rank of each entry that has one in a setting, and whether it is shared.

    Only those that were evaluated alike are compared: what a setting is called is up to a custom entry. An entry is
    behind those whose interval over seeds lies wholly above its own, so an entry that no seeds put behind another has
    rank 1. Two intervals that overlap can have different ranks: a third may lie above one of them alone.
    """
    alike: dict[tuple, dict[str, Estimate]] = {}
    for entry in entries:
        if entry.is_ranked and setting in entry.standings:
            placed = alike.setdefault(entry.said.settings[setting].compared, {})
            placed[entry.name] = entry.standings[setting].placed
    found = {}
    for placed in alike.values():
        rank = {name: 1 + sum(other.low > own.high for other in placed.values()) for name, own in placed.items()}
        found |= {name: (own, list(rank.values()).count(own) > 1) for name, own in rank.items()}
    return found
