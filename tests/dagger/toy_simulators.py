"""`rollout.simulators` of the data sets' toy environments, in this process."""

import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from lerobot_constructskill.rollout import simulators

sys.path.insert(0, str(Path(__file__).parents[1] / "dataset"))
from toy import ToyEnv  # noqa: E402


class Answered(dict):
    """`Answers` that are there."""

    def get(self):
        return self


class InThisProcess:
    """`Simulators` of toys."""

    def __init__(self, env_kwargs):
        self.envs = [ToyEnv(**{k: v for k, v in kwargs.items() if k != "render_backend"}) for kwargs in env_kwargs]

    def reset(self, seeds):
        return Answered({number: simulators._reset(self.envs[number], seed) for number, seed in seeds.items()})

    def step(self, actions):
        answers = {}
        for number, action in actions.items():
            step = simulators._step(self.envs[number], action)
            placed = step.done and self.envs[number].steps < self.envs[number].episode_length
            answers[number] = replace(step, info={"is_success": placed})
        return Answered(answers)


@contextmanager
def toy_simulators(env_kwargs, n_workers=None):
    yield InThisProcess(env_kwargs)
