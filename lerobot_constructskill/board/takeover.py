"""Has the expert take over a failed episode, in copies of the process, which are the one exact snapshot of PhysX.

SAPIEN's `pack` keeps poses and velocities, but no contacts: after `unpack` a held object moves otherwise, and an
episode may end in another step. A forked process keeps all, in milliseconds.
"""

import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing import get_context

import numpy as np

from lerobot_constructskill.artifacts.pools import DIED, be_killed_with_parent
from lerobot_constructskill.board.recovered import PATIENCE, STRIDES
from lerobot_constructskill.board.replay import difference
from lerobot_constructskill.board.submission import Claim
from lerobot_constructskill.contract import get_task
from lerobot_constructskill.demos.expert import Expert, ExpertConfig, make_expert
from lerobot_constructskill.demos.state import PrivilegedState
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import MachineError

STILL = 0.0005
"""Metres that hand, fingers and object move at least in `PATIENCE` steps, unless the expert is stuck."""

EVERY = 10
"""Steps between two attempts in an episode that is drawn to check the search."""

LONGEST_S = 3600
"""Seconds after which a copy that has not answered hangs: every tenth step of a wall of 2,000 takes minutes."""


@dataclass(frozen=True)
class Attempt:
    """What the expert made of a state.

    Args:
        took: steps after which all was placed; None if it was not.
        is_hopeless: whether its last advice was hopeless, as where it gave up.
    """

    took: int | None
    is_hopeless: bool


type Holds = Callable[[int, Attempt], bool]
"""Whether an attempt from a step counts as a recovery."""


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

    def follow(self) -> tuple[str | None, list[PrivilegedState], Attempt]:
        """Execute the whole episode.

        Returns:
            What ends otherwise than claimed, as `replay.difference` says; the state before each action and after the
            last, and the attempt from there.
        """
        states: list[PrivilegedState] = []
        told = difference(self.env, self.claim, lambda: states.append(self.state))
        return told, states, self.take_over()

    def try_every(self, steps: int) -> dict[int, Attempt]:
        """Attempts from every so many steps."""
        tried = {}
        for step in range(0, self.claim.steps, steps):
            self.go(step)
            tried[step] = in_copy(self.take_over)
        return tried


def in_time(claim: Claim) -> Holds:
    """What counts as a recovery within the steps that an episode has."""
    return lambda step, attempt: attempt.took is not None and step + attempt.took <= claim.episode_length


def with_extra_time(step: int, attempt: Attempt) -> bool:
    """What counts as a recovery that may go on after the episode's end."""
    return attempt.took is not None


def last_step(tried: dict[int, Attempt], holds: Holds) -> int | None:
    """The last of the tried steps from which a recovery was found."""
    return max((step for step, attempt in tried.items() if holds(step, attempt)), default=None)


def search(walk: Walk, tried: dict[int, Attempt], holds: Holds) -> dict[int, Attempt]:
    """Try steps until the last tried recovery has a failure right behind it.

    Recovery need not be monotone, so steps are tried from the back, a tenth of the episode apart. The stride behind
    the first that holds is bisected.

    Args:
        walk: at the start of its episode, where it stays.
        tried: attempts by step, that from the episode's end among them.

    Returns:
        `tried` and what was tried beside.
    """
    for ways in (_backwards, _behind):
        last = last_step(tried, holds)
        low = -1 if last is None else last
        high = min((step for step in tried if step > low), default=None)
        if high is None:
            return tried
        tried = tried | ways(walk, low, high, holds)
    return tried


def _backwards(walk: Walk, low: int, high: int, holds: Holds) -> dict[int, Attempt]:
    """The attempts from steps between two, a stride apart, the last first, until one holds."""
    stride = max(walk.claim.steps // STRIDES, 1)
    steps = range((low // stride + 1) * stride, high, stride)
    return in_copy(lambda: _last_first(walk, steps, holds)) if steps else {}


def _last_first(walk: Walk, steps: range, holds: Holds) -> dict[int, Attempt]:
    walk.go(steps[0])
    behind = in_copy(lambda: _last_first(walk, steps[1:], holds)) if steps[1:] else {}
    return behind if last_step(behind, holds) is not None else behind | {steps[0]: in_copy(walk.take_over)}


def _behind(walk: Walk, low: int, high: int, holds: Holds) -> dict[int, Attempt]:
    """The attempts of a bisection between a step that holds, or -1, and one that does not."""

    def bisect_from_low() -> dict[int, Attempt]:
        walk.go(max(low, 0))
        return _bisect(walk, low, high, holds)

    return in_copy(bisect_from_low)


def _bisect(walk: Walk, low: int, high: int, holds: Holds) -> dict[int, Attempt]:
    """The same, of a walk that is at the lower step."""
    if high - low < 2:
        return {}
    middle = (low + high) // 2
    tried = in_copy(lambda: _from_middle(walk, middle, high, holds))
    return tried if holds(middle, tried[middle]) else tried | _bisect(walk, low, middle, holds)


def _from_middle(walk: Walk, middle: int, high: int, holds: Holds) -> dict[int, Attempt]:
    """The attempt from a step, and if it holds, those of a bisection behind it."""
    walk.go(middle)
    attempt = in_copy(walk.take_over)
    return {middle: attempt} | (_bisect(walk, middle, high, holds) if holds(middle, attempt) else {})


def in_copy[Result](work: Callable[[], Result]) -> Result:
    """Call a function in a copy of this process, whose simulator goes its own way.

    Raises:
        OSError: the copy died.
    """
    context = get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    copy = context.Process(target=_answer, args=(work, sender))
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):  # of threads, which wait in C
        copy.start()
    sender.close()
    try:
        if not receiver.poll(LONGEST_S):
            raise EOFError
        return receiver.recv()
    except EOFError:
        raise MachineError(DIED) from None
    finally:
        copy.kill()
        copy.join()


def _answer(work: Callable[[], object], sender) -> None:
    be_killed_with_parent()
    sender.send(work())
