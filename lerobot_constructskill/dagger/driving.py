"""Drives many episodes in lockstep with a learner; the expert labels every state with its own action."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lerobot_constructskill.contract import get_task
from lerobot_constructskill.demos.columns import EXPERT, LEARNER
from lerobot_constructskill.demos.demonstrate import came_of_it, decided, seen
from lerobot_constructskill.demos.expert import Advice, Expert, PrivilegedState
from lerobot_constructskill.envs.actions import action_bounds
from lerobot_constructskill.progress import Progress
from lerobot_constructskill.rollout.agents import Agent, Lockstep, Observation, copies
from lerobot_constructskill.rollout.simulators import Simulators, Step, simulators


@dataclass(frozen=True)
class Drive:
    """How episodes are driven.

    Args:
        number: number of the round, which its frames name.
        beta: probability of the expert's action in a step.
        patience: hopeless steps in a row after which an episode ends; they are dropped.
    """

    number: int
    beta: float
    patience: int


@dataclass
class RunningEpisode:
    """An episode of a round: its frames, in the columns of `columns.dagger_features`, and how it went."""

    seed: int
    now: Step
    rng: np.random.Generator
    frames: list[dict[str, Any]] = field(default_factory=list)
    placed: bool = False
    hopeless: int = 0

    def choose(self, advice: Advice, proposed: np.ndarray, drive: Drive) -> np.ndarray:
        """Return the action of this step, and keep the step's frame with the expert's label."""
        expert = self.rng.random() < drive.beta
        within_bounds = np.clip(np.asarray(proposed, dtype=np.float32), *action_bounds(len(proposed)))
        executed = advice.action if expert else within_bounds
        self.hopeless = self.hopeless + 1 if advice.hopeless else 0
        self.frames.append(
            seen(self.now.seen["pixels"], self.now.agent_state, self.now.sim)
            | decided(advice.action, advice.action, executed, advice.phase, self.seed)
            | {
                "dagger.round": np.array([drive.number], dtype=np.int64),
                "dagger.actor": EXPERT if expert else LEARNER,
                "dagger.hopeless": np.array([advice.hopeless]),
            }
        )
        return executed

    def add(self, step: Step, drive: Drive) -> bool:
        """Complete the step's frame with its outcome, and return whether the episode is over."""
        self.now, self.placed = step, self.placed or step.info["is_success"]
        self.frames[-1] |= came_of_it(step.reward, step.info["is_success"], step.done)
        if self.hopeless < drive.patience:
            return step.done
        del self.frames[-self.hopeless :]
        if self.frames:
            self.frames[-1]["next.done"] = np.array([True])
        return True


def drive_all(
    learner: Agent,
    expert: Expert,
    env_kwargs: Mapping[str, Any],
    seeds: Sequence[int],
    drive: Drive,
    together: int,
    n_workers: int | None = None,
) -> Iterator[RunningEpisode]:
    """Yield an episode of each seed as soon as it is over. No episode depends on those beside it.

    Args:
        together: episodes at a time, each with a copy of the learner.
        n_workers: simulator processes; one per core by default.

    Raises:
        OSError: a simulator's process died.
        Exception: whatever the learner or an environment raises.
    """
    if not (seeds := list(seeds)):
        return
    agents = copies(learner, min(together, len(seeds)))
    instruction = get_task(env_kwargs["task"]).instruction
    with simulators([env_kwargs] * len(agents), n_workers) as sims, Progress(unit="step", desc="driving") as bar:
        lockstep, running = Lockstep(agents), {}
        while seeds or running:
            free = [lane for lane in range(len(agents)) if lane not in running][: len(seeds)]
            running |= _start({lane: seeds.pop(0) for lane in free}, agents, sims)
            observations = {lane: Observation(e.now.seen, e.now.sim, instruction) for lane, e in running.items()}
            proposed = _unwrap(lockstep.act(observations))
            advice = {lane: expert.advise(PrivilegedState(**e.now.sim)) for lane, e in running.items()}
            executed = {lane: e.choose(advice[lane], proposed[lane], drive) for lane, e in running.items()}
            bar.update(len(running))
            for lane, step in _unwrap(sims.step(executed).get()).items():
                if running[lane].add(step, drive):
                    yield running.pop(lane)


def _start(seeds: Mapping[int, int], agents: Sequence[Agent], sims: Simulators) -> dict[int, RunningEpisode]:
    for lane, seed in seeds.items():
        agents[lane].reset(seed)
    steps = _unwrap(sims.reset(seeds).get())
    return {lane: RunningEpisode(seed, steps[lane], np.random.default_rng([seed, 1])) for lane, seed in seeds.items()}


def _unwrap(results: Mapping[int, Any]) -> Mapping[int, Any]:
    for result in results.values():
        if isinstance(result, Exception):
            raise result
    return results
