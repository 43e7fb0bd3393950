"""How long the pieces that are left take, by what was made.

It is rough: a variant that was not made in a setting is taken from another setting or study, whose demonstrations may
be more or longer, and machines differ by a factor of three.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median

from lerobot_constructskill.artifacts.store import Node, Store
from lerobot_constructskill.errors import plural
from lerobot_constructskill.study.runs import Run
from lerobot_constructskill.study.status import tell_seconds
from lerobot_constructskill.study.timing import entries


class Times:
    """Adds up the times of pieces. What several of them need is counted with the first.

    Args:
        folders: where each study has its rows and times.
        episodes: how many each run of a study has.
        store: where runs are made.
    """

    def __init__(self, folders: Mapping[str, Path], episodes: Mapping[str, int], store: Store):
        self._store = store
        self._counted: set[Node | tuple[Node, int]] = set()
        self._took: dict[tuple[str, str, str], list[float]] = defaultdict(list)
        for study, folder in folders.items():
            for entry in entries(folder):  # of a set and its features, of a seed, of an episode
                number = {"training": entry["runs"], "evaluation": entry["runs"] * episodes[study]}
                self._took[study, entry["arm"], entry["stage"]].append(
                    entry["seconds"] / number.get(entry["stage"], 1)
                )
        self._known, self._unknown = 0.0, 0

    def tell(self, study: str, runs: Sequence[Run]) -> str:
        """How long a piece takes: those of its runs that are missing."""
        parts = [seconds for run in runs for seconds in self._parts(study, run)]
        known = sum(seconds for seconds in parts if seconds is not None)
        self._known += known
        if None not in parts:
            return tell_seconds(known)
        self._unknown += 1
        return f"{tell_seconds(known)} and some of unknown time" if known else "time unknown"

    def total(self) -> str:
        """How long all of them take that were told so far."""
        unknown = f"what is unknown of {plural(self._unknown, 'piece')}"
        if not self._unknown:
            return tell_seconds(self._known)
        return f"{tell_seconds(self._known)} and {unknown}" if self._known else unknown

    def _parts(self, study: str, run: Run) -> Iterator[float | None]:
        """The seconds of each stage that a run needs and nobody counted before; None where they are unknown."""
        nodes: dict[str, Node] = {}
        if run.arm.demonstrations:
            nodes["demonstrations"] = run.arm.demonstrations.node
        if run.checkpoints:
            nodes |= {"data": run.checkpoints.inputs["data"], "training": run.checkpoints}
        for stage, node in nodes.items():
            once = (node, run.seed) if stage == "training" else node  # seeds that train together are one node
            if not self._store.has(node) and once not in self._counted:
                self._counted.add(once)
                yield self._each(study, run, stage)
        each = self._each(study, run, "evaluation")
        yield None if each is None else len(run.arm.starts) * each

    def _each(self, study: str, run: Run, stage: str) -> float | None:
        """By the same arm, else by the same variant of its study, else by that of any study.

        It is the median: work of a killed process is not counted, so some are too short.
        """
        same = [key for key in self._took if key[1].split("/")[-1] == run.arm.name and key[2] == stage]
        own = [key for key in same if key[0] == study]
        keys = [key for key in own if key[1] == run.arm.id] or own or same
        return median(seconds for key in keys for seconds in self._took[key]) if keys else None
