"""Has the expert take over a failed episode, from steps of which copies of the process keep the state."""

from collections import deque
from dataclasses import dataclass, field
from functools import partial
from typing import Self

import numpy as np

from lerobot_constructskill.board.forks import Fork, in_fork
from lerobot_constructskill.board.recovered import PATIENCE, STRIDES
from lerobot_constructskill.board.replay import difference
from lerobot_constructskill.board.submission import Claim
from lerobot_constructskill.contract import get_task
from lerobot_constructskill.demos.expert import Expert, ExpertConfig, make_expert
from lerobot_constructskill.demos.state import PrivilegedState
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv

STILL = 0.0005
"""Metres that hand, fingers and object move at least in `PATIENCE` steps, unless the expert is stuck."""

EVERY = 10
"""Steps between two attempts in an episode that is drawn to check the search."""


@dataclass(frozen=True)
class Attempt:
    """What the expert made of a state.

    Args:
        took: steps after which all was placed; None if it was not.
        is_hopeless: whether its last advice was hopeless, as where it gave up.
    """

    took: int | None
    is_hopeless: bool


@dataclass(frozen=True)
class Within:
    """What counts as a recovery.

    Args:
        steps: in which the object has to be placed, counted from the episode's start; None for any number.
    """

    steps: int | None = None

    def holds(self, step: int, attempt: Attempt) -> bool:
        """Whether an attempt from a step is one."""
        return attempt.took is not None and (self.steps is None or step + attempt.took <= self.steps)

    def last(self, tried: dict[int, Attempt]) -> int | None:
        """The last of the tried steps from which it was found."""
        return max((step for step, attempt in tried.items() if self.holds(step, attempt)), default=None)


@dataclass
class Walk:
    """An episode that is executed again, up to a step; a new one is at its start.

    Args:
        env: a simulator of the claim's environment that does not render.
        claim: the episode.
        at: steps that were executed.
    """

    env: ConstructSkillEnv
    claim: Claim
    at: int = 0
    expert: Expert = field(init=False)

    def __post_init__(self):
        self.expert = make_expert(get_task(self.claim.task, self.claim.action), ExpertConfig())
        self.env.reset(seed=self.claim.evaluation_seed)

    @property
    def state(self) -> PrivilegedState:
        return PrivilegedState(**self.env.privileged_state())

    def go(self, step: int) -> None:
        """Execute the episode's actions up to a step that is not before this one."""
        for action in self.claim.executed[self.at : step]:
            self.env.step(action)
        self.at = step

    def take_over(self) -> Attempt:
        """Have the expert act from here on, for as many steps as an episode has, until it places or gives up.

        It gives up where its advice is hopeless, or nothing moves, for `PATIENCE` steps: advice is a function of the
        state, so that it would stay the same.
        """
        places: deque[np.ndarray] = deque(maxlen=PATIENCE)
        hopeless = 0
        for step in range(1, min(self.claim.episode_length, get_task(self.claim.task).horizon) + 1):
            state = self.state
            advice = self.expert.advise(state)
            hopeless = hopeless + 1 if advice.hopeless else 0
            place = np.concatenate([state.tcp, state.object_pose[:3], state.fingers])
            if hopeless == PATIENCE or len(places) == PATIENCE and abs(place - places[0]).max() < STILL:
                break
            places.append(place)
            _, _, is_placed, _, _ = self.env.step(advice.action)
            if is_placed:
                return Attempt(step, False)
        return Attempt(None, hopeless > 0)

    def try_every(self, steps: int) -> dict[int, Attempt]:
        """Attempts from every so many steps."""
        tried = {}
        for step in range(0, self.claim.steps, steps):
            self.go(step)
            tried[step] = in_fork(self.take_over)
        return tried

    def bisect(self, low: int, high: int, within: Within) -> dict[int, Attempt]:
        """Go to a step that is a recovery; attempts between it and one that is none, each in the middle."""
        self.go(low)
        if high - low < 2:
            return {}
        middle = (low + high) // 2
        tried = in_fork(partial(self._try_from, middle, high, within))
        return tried if within.holds(middle, tried[middle]) else tried | self.bisect(low, middle, within)

    def _try_from(self, middle: int, high: int, within: Within) -> dict[int, Attempt]:
        """The attempt from a step, and if it is a recovery, those of a bisection behind it."""
        self.go(middle)
        attempt = in_fork(self.take_over)
        return {middle: attempt} | (self.bisect(middle, high, within) if within.holds(middle, attempt) else {})


class Followed:
    """A whole episode, executed once, of which copies of the process keep the state at every tenth part.

    Args:
        walk: at its start.

    Attributes:
        told: what ends otherwise than claimed, as `replay.difference` says.
        states: before each action and after the last.
    """

    def __init__(self, walk: Walk):
        self.stride = max(walk.claim.steps // STRIDES, 1)
        self.steps = walk.claim.steps
        self.states: list[PrivilegedState] = []
        self._walk, self._kept = walk, dict[int, Fork[Walk]]()

    def __enter__(self) -> Self:
        self.told = difference(self._walk.env, self._walk.claim, self._see)
        return self

    def __exit__(self, *_) -> None:
        for fork in self._kept.values():
            fork.close()

    def _see(self) -> None:
        at = len(self.states)
        self.states.append(self._walk.state)
        if at % self.stride == 0 and at < self.steps:
            self._walk.at = at
            self._kept[at] = Fork(self._walk)

    def search(self, *criteria: Within) -> dict[int, Attempt]:
        """Try steps until the last recovery, by each criterion, has a failure right behind it.

        Recovery need not be monotone, so steps are tried from the back, a tenth of the episode apart. The stride
        behind the first that is a recovery is bisected. The walk itself is behind its episode's end then.
        """
        tried = {self.steps: self._walk.take_over()}
        for within in criteria:
            low, high = _gap(tried, within)
            for step in [step for step in reversed(self._kept) if low < step < high]:
                tried[step] = self._kept[step].ask(Walk.take_over)
                if within.holds(step, tried[step]):
                    break
            low, high = _gap(tried, within)
            if 0 <= low < high - 1:
                kept = self._kept[low // self.stride * self.stride]
                tried |= kept.ask(partial(Walk.bisect, low=low, high=high, within=within))
        return tried

    def try_every(self, steps: int) -> dict[int, Attempt]:
        """Attempts from every so many steps."""
        return self._kept[0].ask(partial(Walk.try_every, steps=steps))


def _gap(tried: dict[int, Attempt], within: Within) -> tuple[int, int]:
    """The last step that is a recovery, or -1, and the next one that was tried, or itself."""
    last = within.last(tried)
    low = -1 if last is None else last
    return low, min((step for step in tried if step > low), default=low)
