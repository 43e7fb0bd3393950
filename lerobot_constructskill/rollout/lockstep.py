"""Many agents evaluated in lockstep: an environment each, and one encoder batch for all that share an encoder."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lerobot_constructskill.contract import OBS_TYPES, get_task
from lerobot_constructskill.envs.recording import STARTING, Outcome, Recording
from lerobot_constructskill.progress import Progress
from lerobot_constructskill.rollout.agents import Agent, Lockstep, Observation, caught
from lerobot_constructskill.rollout.simulators import Simulators, Step, simulators

OnStep = Callable[[int, int, np.ndarray, Step], None]
"""Called with the agent's number, the episode's, the action and what the environment returned for it."""


@dataclass
class Episode(Outcome):
    """How an evaluation episode went; the fields are those of `rows.EpisodeRow`."""

    final_error_m: float | None = None
    clipped_steps: int | None = None

    def add(self, step: Step) -> None:
        """Count one step of the episode."""
        self.count(step.info)
        self.clipped_steps = step.info["clipped_steps"]
        self.final_error_m = float(np.linalg.norm(step.sim["object_pose"][:3] - step.sim["bin_position"]))


@dataclass
class Rollout:
    """What became of one agent: its episodes and the actions of each, or why it failed."""

    episodes: list[Episode] = field(default_factory=list)
    actions: list[list[np.ndarray]] = field(default_factory=list)
    error: Exception | None = None
    backend: str | None = None

    def recordings(self, env_kwargs: Mapping[str, Any]) -> list[Recording]:
        """What was executed, an episode each; `env_kwargs` have all of `recording.STARTING`."""
        facts = {name: env_kwargs[name] for name in STARTING} | {"backend": self.backend}
        return [Recording.of(*pair, **facts) for pair in zip(self.episodes, self.actions, strict=True)]


def roll_out(
    agents: Sequence[Agent],
    env_kwargs: Mapping[str, Any],
    seeds: Sequence[int],
    n_workers: int | None = None,
    on_step: OnStep | None = None,
    filmed: Collection[int] = (),
) -> Iterator[tuple[int, Rollout]]:
    """Run every agent through one episode per seed, in `ConstructSkillEnv(**env_kwargs)`.

    An agent's episodes are those of `lerobot-eval` with the same seeds and one environment, step for step, but for a
    policy that samples. An agent that raises has failed; the others go on.

    Args:
        n_workers: simulator processes; one per core by default.
        filmed: agents of whom `on_step` is shown every camera; of others, those that the agent looks at.

    Yields:
        An agent's number and its outcome, as soon as it has finished or failed.

    Raises:
        OSError: a simulator's process died.
    """
    task = get_task(env_kwargs.get("task", "brick_to_bin"))
    longest = env_kwargs.get("episode_length") or task.horizon
    most = len(agents) * len(seeds) * longest
    envs = [env_kwargs if i in filmed else _rendered(agent, env_kwargs) | env_kwargs for i, agent in enumerate(agents)]
    with (
        simulators(envs, n_workers) as sims,
        Progress(total=most, unit="step", desc="rollout") as bar,
    ):
        lanes = _Lanes(agents, task.instruction, sims, seeds, on_step)
        bar.unpause()  # until now the simulators started
        while lanes.current:
            bar.total = bar.n + lanes.steps_left(longest)
            bar.update(len(lanes.current))
            bar.set_postfix(running=len(lanes.current), refresh=False)
            lanes.advance()
            yield from lanes.settled()
        yield from lanes.settled()


def _rendered(agent: Agent, env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Have rendered what an agent looks at; one camera at least, as a backend that renders is a part of the result."""
    offered = OBS_TYPES.get(env_kwargs.get("obs_type", "pixels"), ())
    looked = getattr(agent, "cameras", offered)
    return {"cameras": tuple(name for name in offered if name in looked) or offered[:1]}


class _Lanes:
    """The agents that still run, and what each of them sees."""

    def __init__(self, agents, instruction: str, sims: Simulators, seeds: Sequence[int], on_step: OnStep | None):
        self.agents, self.sims, self.seeds, self.on_step = agents, sims, seeds, on_step
        self.instruction = instruction
        self.lockstep = Lockstep(agents)
        self.outcomes = [Rollout() for _ in agents]
        self.current: dict[int, Step] = {}
        self._reported: set[int] = set()
        self._start(range(len(agents)))

    def advance(self) -> None:
        """One step of every agent that still runs."""
        seen = {i: Observation(step.seen, step.sim, self.instruction) for i, step in self.current.items()}
        actions = self._settle(self.lockstep.act(seen))
        self.current = self._settle(self.sims.step(actions))
        for i, step in self.current.items():
            self.outcomes[i].episodes[-1].add(step)
            self.outcomes[i].actions[-1].append(np.array(actions[i]))  # an agent may use its array again
            if self.on_step:
                self.on_step(i, len(self.outcomes[i].episodes) - 1, actions[i], step)
        finished = [i for i, step in self.current.items() if step.done]
        for i in finished:
            del self.current[i]
        self._start([i for i in finished if len(self.outcomes[i].episodes) < len(self.seeds)])

    def steps_left(self, longest: int) -> int:
        """At most so many steps are left, where an episode has at most `longest`."""
        left = (self.outcomes[i].episodes for i in self.current)
        return sum((len(self.seeds) - len(episodes) + 1) * longest - episodes[-1].steps for episodes in left)

    def settled(self) -> Iterator[tuple[int, Rollout]]:
        """The agents that have stopped since this was last asked."""
        for i in set(range(len(self.agents))) - self.current.keys() - self._reported:
            self._reported.add(i)
            if self.outcomes[i].error is None:
                self.outcomes[i].backend = self.sims.backend(i)
            yield i, self.outcomes[i]

    def _start(self, numbers: Sequence[int]) -> None:
        """Begin the next episode of these agents."""
        seeds = {i: self.seeds[len(self.outcomes[i].episodes)] for i in numbers}
        for i, seed in seeds.items():
            self.outcomes[i].episodes.append(Episode(seed))
            self.outcomes[i].actions.append([])
        ready = self._settle({i: caught(self.agents[i].reset, seed) for i, seed in seeds.items()})
        self.current |= self._settle(self.sims.reset({i: seeds[i] for i in ready}))

    def _settle(self, results: dict[int, Any]) -> dict[int, Any]:
        """Take out the agents whose result is an exception: they have failed."""
        for i, result in results.items():
            if isinstance(result, Exception):
                self.outcomes[i] = Rollout(error=result)
        return {i: result for i, result in results.items() if not isinstance(result, Exception)}
