"""How long runs that are to be made will take, by what others took.

It is rough: a variant that was not made in a setting is taken from another setting or study, whose demonstrations may
be longer, and machines differ by a factor of three.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median

from lerobot_constructskill.artifacts.store import Node, Store
from lerobot_constructskill.study.runs import Arm, Run
from lerobot_constructskill.study.timing import OF_RUNS, entries, seconds_of_one


class Estimates:
    """Adds up the times of runs. What several of them need is counted with the first.

    Args:
        folders: where each study has its rows and times.
        runs: of each study, made or not.
        store: where runs are made.
    """

    def __init__(self, folders: Mapping[str, Path], runs: Mapping[str, Sequence[Run]], store: Store):
        self._store = store
        self._counted: set[Node | tuple[Node, int]] = set()
        self._took: dict[tuple[str, str, str], list[float]] = defaultdict(list)
        for study, folder in folders.items():
            arms = {run.arm.id: run.arm for run in runs[study]}
            for entry in entries(folder):
                if arm := arms.get(entry["arm"]):
                    stage = entry["stage"]
                    self._took[study, arm.id, stage].append(seconds_of_one(entry) / _size(arm, stage))
        self._known, self._is_known = 0.0, True

    def tell(self, study: str, runs: Sequence[Run]) -> str:
        """How long it takes to make some runs that are missing."""
        parts = [seconds for run in runs for seconds in self._parts(study, run)]
        known, is_known = sum(seconds for seconds in parts if seconds is not None), None not in parts
        self._known += known
        self._is_known = self._is_known and is_known
        return _told(known, is_known)

    def total(self) -> str:
        """How long all of them take that were told so far."""
        return _told(self._known, self._is_known)

    def _parts(self, study: str, run: Run) -> Iterator[float | None]:
        """The seconds of each stage that a run needs and nobody counted before; None where they are unknown."""
        nodes: dict[str, Node] = {}
        if run.arm.demonstrations:
            nodes["demonstrations"] = run.arm.demonstrations.node
        if run.checkpoints:
            nodes |= {"data": run.checkpoints.inputs["data"], "training": run.checkpoints}
        for stage, node in nodes.items():
            once = (node, run.seed) if stage == "training" else node  # seeds that train together are one node
            if not (node.is_passing or self._store.has(node)) and once not in self._counted:
                self._counted.add(once)
                yield self._of(study, run, stage)
        yield self._of(study, run, "evaluation")

    def _of(self, study: str, run: Run, stage: str) -> float | None:
        """By the same arm, else by the same variant of its study, else of any study; of demonstrations, else by
        another arm of the setting.

        It is the median: work of a killed process is not counted, so some are too short.
        """
        same = [key for key in self._took if key[2] == stage]
        alike = [key for key in same if key[1].endswith(f"/{run.arm.name}")]
        beside = [key for key in same if key[0] == study and key[1].startswith(f"{run.arm.setting}/")]
        choices = (
            [key for key in alike if key[:2] == (study, run.arm.id)],
            [key for key in alike if key[0] == study],
            alike,
            beside if stage == "demonstrations" else [],
        )
        keys = next(filter(None, choices), [])
        return _size(run.arm, stage) * median(one for key in keys for one in self._took[key]) if keys else None


def _size(arm: Arm, stage: str) -> int:
    """By what the time of a stage is counted: episodes of the evaluation, or demonstrations; a training as a whole."""
    if stage in OF_RUNS:
        return len(arm.starts) if stage == "evaluation" else 1
    return arm.demonstrations.node.config.episodes if arm.demonstrations else 1


def _told(known: float, is_known: bool) -> str:
    """Seconds in the unit that suits them, and whether there are more."""
    units = ((3600, "h"), (60, "min"), (1, "s"))
    size, unit = next(one for one in units if known >= 1.5 * one[0] or one[0] == 1)
    told = f"about {known / size:.0f} {unit}"
    return told if is_known else f"{told} and some of unknown time" if known else "time unknown"
