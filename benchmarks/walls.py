"""A step of an environment with nine bricks against one with one, with and without pictures.

The expert of each acts, and its action is timed apart: with what it reads, the privileged state, it is the price of a
demonstration beside the step. All take turns, a block of steps each, in CPU time and with one thread, as in a worker
that generates demonstrations.
"""

import os
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from measure import CpuTimer, report

from lerobot_constructskill.contract import get_task
from lerobot_constructskill.demos.expert import ExpertConfig, PrivilegedState, make_expert
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.plans.plan import written

BLOCKS, STEPS = 12, 50

NINE = {
    "a": {"at": [-0.40, -0.25]},
    "b": {"beside": "a"},
    "c": {"beside": "b"},
    "d": {"at": [-0.40, -0.45]},
    "e": {"beside": "d"},
    "f": {"on": ["a", "b"]},
    "g": {"on": ["b", "c"]},
    "h": {"on": ["d", "e"]},
    "i": {"on": ["f", "g"]},
}
"""Two walls, one of three courses and one of two: where each brick goes."""


class Acting:
    """An expert in its task, episode after episode, and the CPU time of its parts."""

    def __init__(self, task: str, render_backend: str):
        self.env = ConstructSkillEnv(task, render_backend=render_backend, episode_length=10_000)
        self.expert = make_expert(get_task(task), ExpertConfig())
        self.seed, self.progress = 0, None
        self.step, self.state, self.action = CpuTimer(), CpuTimer(), CpuTimer()

    def run(self) -> None:
        for _ in range(STEPS):
            if self.progress is None:
                self.seed += 1
                self.env.reset(seed=self.seed)
                self.progress = self.expert.start(PrivilegedState(**self.env.privileged_state()))
            with self.state:
                state = PrivilegedState(**self.env.privileged_state())
            with self.action:
                action, _, self.progress = self.expert.act(state, self.progress)
            with self.step:
                self.env.step(action)

    def forget(self) -> None:
        for timer in (self.step, self.state, self.action):
            timer.seconds = 0.0


def main() -> None:
    os.environ["LP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)
    with TemporaryDirectory() as folder:
        plan = Path(folder) / "nine.yaml"
        elements = {name: {"kind": "brick"} | place for name, place in NINE.items()}
        plan.write_text(written({"elements": elements}), encoding="utf-8")
        tasks = {"nine": f"plan:{plan}", "one": "brick_on_brick"}
        runs = {(name, how): Acting(task, how) for name, task in tasks.items() for how in ("none", "cpu")}
        for one in runs.values():
            one.run()
            one.forget()
        for _ in range(BLOCKS):
            for one in runs.values():
                one.run()
    for how, told in (("none", "without pictures"), ("cpu", "one camera")):
        nine, one = runs["nine", how], runs["one", how]
        for part, what in (("step", "an environment's step"), ("state", "privileged state"), ("action", "the expert")):
            ours, theirs = (1000 * getattr(run, part).seconds / (BLOCKS * STEPS) for run in (nine, one))
            asked = 0.5 if part == "step" else None
            report(f"CPU ms of {what}, nine bricks, {told}", ours, "one brick", theirs, asked, less_is_better=True)


if __name__ == "__main__":
    main()
