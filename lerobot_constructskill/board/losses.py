"""Tells where a policy's failed episodes were lost: counts, curves, and how far the search can be believed."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median

from lerobot_constructskill.analysis.report.formats import p_value
from lerobot_constructskill.analysis.stats.comparisons import association
from lerobot_constructskill.board.entries import Entry
from lerobot_constructskill.board.recovered import FAILED, Recovery
from lerobot_constructskill.errors import plural

FEWEST = 10
"""Failures below which nothing is said of how seeds differ in them."""


@dataclass(frozen=True)
class Losses:
    """Failed episodes of one kind.

    Args:
        rows: their recoveries, at least one.
    """

    rows: Sequence[Recovery]

    @property
    def lost(self) -> str:
        """What was lost, with counts, the most frequent first: "dropped 3, tipped 1"."""
        return _counted(row.lost for row in self.rows)

    @property
    def phase(self) -> str:
        """The phases of the last steps from which the expert placed, likewise."""
        return _counted(row.phase.lower() for row in self.rows if row.phase is not None)

    @property
    def last_step(self) -> float | None:
        """Median of the last steps from which the expert places within the steps that are left."""
        return _median(row.last_step for row in self.rows)

    @property
    def hand_mm(self) -> float | None:
        """Median distance of hand and object in the last step from which the expert places."""
        return _median(row.hand_mm for row in self.rows)

    @property
    def goal_mm(self) -> float | None:
        """The same of object and goal."""
        return _median(row.goal_mm for row in self.rows)

    @property
    def at_the_end(self) -> int:
        """How many the expert still places from their last state, with more time."""
        return sum(row.last_step_extra == row.steps for row in self.rows)

    @property
    def hopeless(self) -> int:
        """How many are lost to this expert: it gives up."""
        return sum(row.is_hopeless for row in self.rows)

    def curve(self, extra: bool = False) -> str:
        """Share of them that the expert still places from each step on, as an SVG path in a square of 1.

        Args:
            extra: whether the expert may go on after the episode's end.
        """
        steps = max(row.steps for row in self.rows)
        lasts = [row.last_step_extra if extra else row.last_step for row in self.rows]
        falls = sorted(0 if last is None else last + 1 for last in lasts)
        drawn = [f"H{at / steps:.4g}V{n / len(falls):.4g}" for n, at in enumerate(falls, start=1) if at <= steps]
        return f"M0 0{''.join(drawn)}H1"


def by_setting(rows: Iterable[Recovery]) -> dict[str, Losses]:
    """The losses of each setting."""
    return _grouped(rows, lambda row: row.setting)


def by_seed(losses: Losses) -> dict[int, Losses]:
    """The losses of each training seed."""
    return _grouped(losses.rows, lambda row: row.training_seed)


def depends_on_seed(losses: Losses) -> str:
    """Whether what was lost depends on the training seed: the p-value of a permutation of episodes from one start."""
    strata = _grouped(losses.rows, lambda row: row.evaluation_seed).values()
    can_differ = any(
        len({row.training_seed for row in one.rows}) > 1 < len({row.lost for row in one.rows}) for one in strata
    )
    if len(losses.rows) < FEWEST or not can_differ:
        return "cannot be told from these failures"
    of_each = ([getattr(row, name) for row in losses.rows] for name in ("training_seed", "lost", "evaluation_seed"))
    return f"p = {p_value(association(*of_each))}"


def checked(rows: Iterable[Recovery]) -> tuple[int, int, int, int]:
    """How far the search can be believed, which takes recovery as possible up to the last step and never behind it.

    Returns:
        The episodes in which every tenth step was tried, the steps that were tried in them, how many of these do not
        place though a later one does, and how many place behind the step that was found.
    """
    drawn = [row for row in rows if row.is_drawn and row.tried]
    tried = [
        (took != FAILED, step > (-1 if row.last_step_extra is None else row.last_step_extra))
        for row in drawn
        for step, took in zip(row.tried, row.took, strict=True)
    ]
    return len(drawn), len(tried), tried.count((False, False)), tried.count((True, True))


def tell(entry: Entry) -> list[str]:
    """A sentence for each setting in which an entry failed."""
    return [
        f"{entry.name}, {setting}: {plural(len(own.rows), 'failed episode')}: {own.lost}; still placed from the end, "
        f"with more time: {own.at_the_end}; depends on the training seed: {depends_on_seed(own)}"
        for setting, own in by_setting(entry.recoveries.values()).items()
    ]


def _grouped(rows, key) -> dict:
    groups: dict = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return {name: Losses(own) for name, own in sorted(groups.items())}


def _counted(values: Iterable[str]) -> str:
    return ", ".join(f"{value} {count}" for value, count in Counter(values).most_common())


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None
