"""The axes along which any task can be perturbed, and their levels. Standard library only.

Level 0 is the task as it is. What is drawn once (camera, light, textures, size, distractors) follows from the axis
and a seed alone; what it draws every episode (initial pose, sensor noise) from the episode's own seed. The latency
draws nothing, and the seed chooses among the sentences of a level.
"""

import re
from dataclasses import dataclass, replace

from lerobot_constructskill.contract import SHIPPED, SUITES, Task
from lerobot_constructskill.errors import InputError


@dataclass(frozen=True)
class Axis:
    """One thing that can be perturbed.

    Args:
        unit: what a level's number is.
        levels: the numbers of levels 1, 2, ...
        changes: which of `CHANGEABLE` it changes by itself; nothing else differs but what follows from these.
    """

    unit: str
    levels: tuple[float, ...]
    changes: tuple[str, ...]


BODIES = ("robot", "object", "receptacle")
CHANGEABLE = ("base", "wrist", *BODIES, "execution", "instruction")
"""The pictures of both cameras, the state of the bodies at the start, how an action is executed, and the sentence."""

_BOTH = ("base", "wrist")

AXES = {
    "camera": Axis("metres between the base camera's eye and its nominal place", (0.02, 0.05, 0.10), ("base",)),
    "light": Axis("relative change of the lights' brightness, and of their direction", (0.2, 0.4, 0.6), _BOTH),
    "texture": Axis(
        "relative change of the brick's and the ground's colour, with another pattern", (0.1, 0.2, 0.4), _BOTH
    ),
    "size": Axis(
        "factor of the square root of a brick's dimension: EN 771-1's categories T2 and T1",
        (0.25, 0.40),
        ("object", "receptacle"),
    ),
    "distractors": Axis("fixed offcuts beside the work", (1, 2, 4), _BOTH),
    "pose": Axis("standard deviation of the robot's initial joint angles in radians", (0.01, 0.02, 0.04), ("robot",)),
    "sensor": Axis("standard deviation of the pixel noise, of 255", (4, 8, 16), _BOTH),
    "latency": Axis("steps by which an action is executed late", (1, 2, 4), ("execution",)),
    "language": Axis(
        "how far the sentence is from the task's own, with the same meaning", (1, 2, 3), ("instruction",)
    ),
    "wrong_task": Axis("whether the sentence is that of another task, as control", (1,), ("instruction",)),
}

PICTURES = ("light", "texture", "sensor")
"""Axes that change every picture of every camera, and nothing that moves."""


def _other(task: Task) -> str:
    """The sentence of the next task of the suite, or of this package, that is asked otherwise."""
    suites = (names for names in SUITES.values() if task.name in names)
    names = next(suites, tuple(SHIPPED))
    after = names.index(task.name) + 1 if task.name in names else 0
    sentences = (SHIPPED[name].instruction for name in (*names[after:], *names[:after], *SHIPPED))
    return next(sentence for sentence in sentences if sentence != task.instruction)


@dataclass(frozen=True)
class Perturbation:
    """Which axes are perturbed, how far, and by which draw.

    Args:
        levels: `axis=level` with commas between, such as `camera=2,light=1`; empty for none.
        seed: of what is drawn once.

    Raises:
        ValueError: an axis, or a level of it, that does not exist.
    """

    levels: str = ""
    seed: int = 0

    def __post_init__(self):
        pairs = self._pairs()
        for name, level in pairs:
            if name not in AXES:
                raise InputError(f"Unknown perturbation '{name}'; the axes are: {', '.join(AXES)}.")
            highest = len(AXES[name].levels)
            if not re.fullmatch("[0-9]{1,2}", level) or int(level) > highest:
                raise InputError(f"The level of '{name}' must be 0 to {highest}, not '{level[:20]}'.")
        if len(dict(pairs)) < len(pairs):
            raise InputError(f"Each axis has one level; '{self.levels}' names one twice.")

    def check(self, task: Task) -> None:
        """Raise InputError where another size is asked of a task without a brick, or other words that it lacks."""
        self.check_size(task.is_brick, task.name)
        if self.amount("language") >= max(1, len(task.rewordings)):
            raise InputError(f"The row of {task.name} has no rewordings of level {self._level('language')}.")

    def check_size(self, is_brick: bool, name: str = "this task") -> None:
        """Raise InputError where another size is asked of a task whose object is no brick."""
        if self.amount("size") and not is_brick:
            raise InputError(
                f"The axis 'size' is EN 771-1's tolerance of a task's one brick; {name} has no brick, "
                "or bricks with sizes of their own."
            )

    def told(self, task: Task) -> Task:
        """The row of `task` with the sentence that is said: its own, one that means the same, or another task's."""
        if self.amount("wrong_task"):
            return replace(task, instruction=_other(task))
        if level := self._level("language"):
            said = task.rewordings[level]
            return replace(task, instruction=said[self.seed % len(said)])
        return task

    def _pairs(self) -> list[tuple[str, str]]:
        parts = [part.partition("=") for part in self.levels.split(",") if part.strip()]
        return [(name.strip(), level.strip()) for name, _, level in parts]

    def _level(self, axis: str) -> int:
        return int(dict(self._pairs()).get(axis, 0))

    def amount(self, axis: str) -> float:
        """How far `axis` is perturbed, in the axis's unit; 0 where it is not."""
        return (0.0, *AXES[axis].levels)[self._level(axis)]

    @property
    def pictures(self) -> tuple[float, ...]:
        """Amounts of the axes that change all pictures and nothing else."""
        return tuple(self.amount(axis) for axis in PICTURES)

    @property
    def label(self) -> str:
        """The mark of results: empty without a perturbation, else such as `+camera=2+light=1+seed=0`.

        Two spellings of one perturbation have one label.
        """
        named = [f"+{axis}={level}" for axis in AXES if (level := self._level(axis))]
        return "".join([*named, f"+seed={self.seed}"]) if named else ""
