"""How long the pieces that are left take, by those that were made: roughly, as machines differ."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

from lerobot_constructskill.artifacts.store import Node, Store
from lerobot_constructskill.errors import plural
from lerobot_constructskill.study.runs import Run
from lerobot_constructskill.study.status import tell_seconds
from lerobot_constructskill.study.timing import entries

SET, SEED, EPISODES = ("demonstrations",), ("data", "training"), ("evaluation",)
"""Stages, by what they take their time for."""


@dataclass(frozen=True)
class _Unit:
    """Seconds that a stage took for one set of demonstrations, one seed or one episode."""

    study: str
    arm: str
    stage: str
    seconds: float


class Times:
    """Adds up the times of pieces. What several of them need is counted with the first.

    Args:
        folders: where each study has its rows and times.
        episodes: how many each run of a study has.
        store: where runs are made.
    """

    def __init__(self, folders: Mapping[str, Path], episodes: Mapping[str, int], store: Store):
        self._store = store
        self._units = [unit for study, folder in folders.items() for unit in _units(study, folder, episodes[study])]
        self._counted: set[tuple[Node, int | None]] = set()
        self._seconds, self._unknown = 0.0, 0

    def tell(self, study: str, runs: Sequence[Run]) -> str:
        """How long a piece takes: those of its runs that are missing."""
        try:
            seconds = sum(self._of(study, run) for run in runs)
        except LookupError:
            self._unknown += 1
            return "time unknown"
        self._seconds += seconds
        return tell_seconds(seconds)

    def total(self) -> str:
        """How long all of them take that were told so far."""
        known = [tell_seconds(self._seconds)] if self._seconds else []
        return ", and ".join(known + ([f"{plural(self._unknown, 'piece')} of unknown time"] if self._unknown else []))

    def _of(self, study: str, run: Run) -> float:
        arm = run.arm
        seconds = len(arm.starts) * self._each(study, run, EPISODES)
        if arm.demonstrations and self._is_first(arm.demonstrations.node):
            seconds += self._each(study, run, SET)
        if arm.learner and self._is_first(run.checkpoints, run.seed):
            seconds += self._each(study, run, SEED)
        return seconds

    def _is_first(self, node: Node, seed: int | None = None) -> bool:
        """Whether a node is not made, and counted only now."""
        is_first = not self._store.has(node) and (node, seed) not in self._counted
        self._counted.add((node, seed))
        return is_first

    def _each(self, study: str, run: Run, stages: Sequence[str]) -> float:
        """Of stages: as the same arm took, else the same variant, and in the same study rather than in others.

        Raises:
            LookupError: there is none of that name.
        """
        same = [unit for unit in self._units if unit.arm.split("/")[-1] == run.arm.name and unit.stage in stages]
        for fits in (lambda unit: (unit.study, unit.arm) == (study, run.arm.id), lambda unit: unit.study == study):
            same = [unit for unit in same if fits(unit)] or same
        each = {unit.stage: [] for unit in same}
        for unit in same:
            each[unit.stage].append(unit.seconds)
        if not each:
            raise LookupError(run.arm.id)
        return sum(map(mean, each.values()))


def _units(study: str, folder: Path, episodes: int) -> Iterator[_Unit]:
    for entry in entries(folder):
        for stages, number in ((SET, 1), (SEED, entry["runs"]), (EPISODES, entry["runs"] * episodes)):
            if entry["stage"] in stages:
                yield _Unit(study, entry["arm"], entry["stage"], entry["seconds"] / number)
