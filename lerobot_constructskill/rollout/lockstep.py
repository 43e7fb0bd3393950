"""Many agents evaluated in lockstep, with an environment each.

They step in two halves: the environments of one are at work while the agents of the other act. Those of a half that
share an encoder have one batch of it. Where there are fewer agents than two for each simulator process, an agent's
episodes run side by side, each share of them with a copy of it. Of an agent that looks at no picture, as the expert,
only the first episode is rendered.
"""

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import batched
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_constructskill.artifacts.pools import cores
from lerobot_constructskill.contract import FPS, OBS_TYPES, get_task
from lerobot_constructskill.envs.recording import STARTING, Episode, deciding
from lerobot_constructskill.lerobot_internals import write_video
from lerobot_constructskill.perturbations import Perturbation
from lerobot_constructskill.plans.measure import measured
from lerobot_constructskill.plans.plan import read_plan
from lerobot_constructskill.progress import Progress, quiet
from lerobot_constructskill.rollout.agents import Agent, Lockstep, Observation, PolicyAgent, caught, copies
from lerobot_constructskill.rollout.simulators import Answers, Simulators, Step, simulators

MOST_LANES = 16
"""Lanes that a few agents are given: one process acts for all of them, and cannot keep more simulators busy."""

OnStep = Callable[[int, int, np.ndarray, Step], None]
"""Called with the agent's number, the episode's, the action and what the environment returned for it."""


@dataclass
class Rollout:
    """Result of one agent: its episodes, or the exception with which it failed."""

    episodes: list[Episode] = field(default_factory=list)
    error: Exception | None = None
    backend: str | None = None

    def recordings(self, env_kwargs: Mapping[str, Any]) -> list[Episode]:
        """The episodes with the environment that they were run in; `env_kwargs` have all of `recording.STARTING`."""
        facts = {name: env_kwargs[name] for name in STARTING}
        facts |= {"backend": self.backend, "versions": json.dumps(deciding())}
        return [replace(episode, **facts) for episode in self.episodes]


def roll_out(
    agents: Sequence[Agent],
    env_kwargs: Mapping[str, Any],
    seeds: Sequence[Sequence[int]],
    n_workers: int | None = None,
    on_step: OnStep | None = None,
    filmed: Collection[int] = (),
) -> Iterator[tuple[int, Rollout]]:
    """Run every agent through its episodes in `ConstructSkillEnv(**env_kwargs)`.

    An agent's episodes are those of `lerobot-eval` with the same seeds and one environment, step for step, but for a
    policy that samples. An agent that raises has failed; the others go on.

    Args:
        seeds: for each agent those of its episodes' initial states.
        n_workers: simulator processes; one per core by default.
        filmed: agents of whom `on_step` is shown every camera, in the first episode at least; of others, those that
            the agent looks at.

    Yields:
        An agent's number and its rollout, as soon as it has finished or failed.

    Raises:
        OSError: a simulator's process died.
    """
    n_workers = n_workers or cores()
    lanes = [
        lane
        for number, (agent, own) in enumerate(zip(agents, seeds, strict=True))
        for lane in _lanes_of(number, agent, own, env_kwargs, number in filmed, n_workers, len(agents))
    ]
    with (
        simulators([lane.env for lane in lanes], n_workers) as sims,
        Progress(total=sum(map(len, seeds)), unit="episode", desc="rollout") as bar,
    ):
        shared = Lockstep([lane.agent for lane in lanes])
        groups = [
            _Together(numbers, lanes, shared, env_kwargs, sims, on_step) for numbers in _halves(range(len(lanes)))
        ]
        over: dict[int, dict[int, Rollout]] = {number: {} for number in range(len(agents))}  # by agent and lane
        bar.unpause()  # until now the simulators started
        while any(group.running or group.over for group in groups):
            for group in groups:
                bar.update(group.advance())
                for i, rollout in group.finished():
                    number = lanes[i].number
                    over[number][i] = rollout
                    if len(over[number]) == sum(lane.number == number for lane in lanes):
                        yield number, _joined([one for _, one in sorted(over.pop(number).items())])


@dataclass(frozen=True)
class _Lane:
    """Episodes of an agent, one after another in an environment.

    Args:
        number: of the agent, whose copies have it too.
        first: which of the agent's episodes comes first.
        seeds: those of the episodes' initial states.
        env: keyword arguments of the environment.
    """

    number: int
    agent: Agent
    first: int
    seeds: Sequence[int]
    env: Mapping[str, Any]


def _lanes_of(
    number: int,
    agent: Agent,
    seeds: Sequence[int],
    env_kwargs: Mapping[str, Any],
    is_filmed: bool,
    n_workers: int,
    n_agents: int,
) -> list[_Lane]:
    """An agent's lanes.

    A policy whose class has an `in_lockstep` of its own has several, and so has an agent that looks at no camera. Any
    other has one: it may be large, or remember its last episode.
    """
    offered = OBS_TYPES.get(env_kwargs.get("obs_type", "pixels"), ())
    looked = getattr(agent, "cameras", offered)
    # At least one picture is rendered, because a row says what backend did it.
    cameras = {"cameras": tuple(name for name in offered if name in looked) or offered[:1]}
    seen = cameras | env_kwargs
    if isinstance(agent, PolicyAgent) or looked:
        is_forgetful = isinstance(agent, PolicyAgent) and agent.is_forgetful
        count = ceil(min(2 * n_workers, MOST_LANES) / n_agents) if is_forgetful else 1
        shares, rest = _shares(range(len(seeds)), count), seen
    else:
        shares = [range(1), *_shares(range(1, len(seeds)), n_workers)]
        rest = {**env_kwargs, "render_backend": "none"}
    envs = [env_kwargs if is_filmed else seen, *[rest] * (len(shares) - 1)]
    return [
        _Lane(number, one, share[0], seeds[share[0] : share[-1] + 1], env)
        for one, share, env in zip(copies(agent, len(shares)), shares, envs, strict=True)
    ]


def _shares(episodes: range, count: int) -> list[Sequence[int]]:
    """Split episodes into at most `count` shares; the last may be shorter than the others."""
    return [*batched(episodes, ceil(len(episodes) / count))] if episodes else []  # noqa: B911


def _joined(rollouts: Sequence[Rollout]) -> Rollout:
    """The rollout of an agent from those of its lanes, in their order."""
    failed = [rollout for rollout in rollouts if rollout.error]
    episodes = [episode for rollout in rollouts for episode in rollout.episodes]
    return failed[0] if failed else Rollout(episodes, backend=rollouts[0].backend)


def _halves(numbers: range) -> list[range]:
    """Both halves: while the environments of one are at work, the agents of the other act."""
    middle = (len(numbers) + 1) // 2
    return [half for half in (numbers[:middle], numbers[middle:]) if half]


class _Together:
    """Lanes that step together, and what their environments were asked last.

    Args:
        numbers: which of `lanes` they are.
        shared: what all agents compute together.
    """

    def __init__(
        self,
        numbers: Sequence[int],
        lanes: Sequence[_Lane],
        shared: Lockstep,
        env_kwargs: Mapping[str, Any],
        sims: Simulators,
        on_step: OnStep | None,
    ):
        self.lanes, self.shared, self.sims, self.on_step = lanes, shared, sims, on_step
        task = get_task(env_kwargs.get("task", "brick_to_bin"))
        perturbation = Perturbation(env_kwargs.get("perturb", ""), env_kwargs.get("perturb_seed", 0))
        self.instruction, self.plan = perturbation.told(task).instruction, task.plan and read_plan(task.plan)
        self.running = {i: Rollout() for i in numbers}
        self.over: dict[int, Rollout] = {}
        self.actions: dict[int, np.ndarray] = {}
        self.asked = [self._start(numbers)]

    def advance(self) -> int:
        """Take what the environments answered, act, and ask them again; return how many episodes ended."""
        current = self._succeeded({i: answer for asked in self.asked for i, answer in asked.get().items()})
        for i in self.actions.keys() & current.keys():
            self._keep(i, current[i])
        ended = [i for i, step in current.items() if step.done]
        for i in ended:
            self.running[i].backend = current.pop(i).backend
        again = [i for i in ended if len(self.running[i].episodes) < len(self.lanes[i].seeds)]
        self.over |= {i: self.running.pop(i) for i in ended if i not in again}
        self.asked = [self._start(again)]  # before others act, so that it goes on meanwhile
        seen = {i: Observation(step.seen, step.sim, self.instruction) for i, step in current.items()}
        self.actions = self._succeeded(self.shared.act(seen))
        self.asked.append(self.sims.step(self.actions))
        return len(ended)

    def finished(self) -> Iterator[tuple[int, Rollout]]:
        """The lanes that have finished or failed since the last time."""
        over, self.over = self.over, {}
        yield from over.items()

    def _keep(self, i: int, step: Step) -> None:
        """Add a lane's step to its episode."""
        episodes, action = self.running[i].episodes, self.actions[i]
        episodes[-1].add(action, step.info)
        episodes[-1].final_error_m = float(np.linalg.norm(step.sim["object_pose"][:3] - step.sim["bin_position"]))
        if step.done and self.plan:
            episodes[-1].measures = measured(self.plan, step.sim)
        if self.on_step:
            lane = self.lanes[i]
            self.on_step(lane.number, lane.first + len(episodes) - 1, action, step)

    def _start(self, numbers: Sequence[int]) -> Answers:
        """Begin the next episode of these lanes."""
        seeds = {i: self.lanes[i].seeds[len(self.running[i].episodes)] for i in numbers}
        for i, seed in seeds.items():
            self.running[i].episodes.append(Episode(seed))
        ready = self._succeeded({i: caught(self.lanes[i].agent.reset, seed) for i, seed in seeds.items()})
        return self.sims.reset({i: seeds[i] for i in ready})

    def _succeeded(self, results: dict[int, Any]) -> dict[int, Any]:
        """The results that are no exception; a lane whose result is one has failed."""
        failed = {i: result for i, result in results.items() if isinstance(result, Exception)}
        for i, error in failed.items():
            del self.running[i]
            self.over[i] = Rollout(error=error)
        return {i: result for i, result in results.items() if i not in failed}


class FirstEpisode:
    """The frames of one agent's first episode, seen by the base camera.

    Args:
        number: which agent is filmed; None for no agent.
    """

    def __init__(self, number: int | None):
        self._number = number
        self._frames: list[np.ndarray] = []

    def add(self, number: int, episode: int, action: np.ndarray, step: Step) -> None:
        """Keep a frame of the first episode; called as `OnStep`."""
        if number == self._number and episode == 0:
            self._frames.append(step.seen["pixels"]["base"])

    def write(self, number: int, path: Path) -> None:
        """Write the video of an agent, if it is the one that was filmed."""
        if number == self._number and self._frames:
            with quiet():
                write_video(path, self._frames, FPS)
