"""`constructskill-check-task`: check a new task: its tests, its expert's success, and a contact sheet to look at."""

import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_constructskill.bounds import Count, check
from lerobot_constructskill.contract import DEMO_SEED_START, get_task
from lerobot_constructskill.demos.expert import ExpertConfig
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.scripts.console import run
from lerobot_constructskill.scripts.no_noise import NoNoise

TILE = 224
"""Height and width of a picture in the contact sheet, in pixels."""

CHECKOUT = Path(__file__).parents[2]
"""Where this lies in one, with its tests; an installed package has none."""

REQUIRED = 0.95
"""Share of random initial states in which an expert must succeed."""


@dataclass
class CheckTaskConfig:
    """Check one task of the contract table.

    Raises:
        ValueError: there is no such task, the counts are out of range, or the task fails its check.
    """

    task: str  # a name in `contract.TASKS`
    states: Count = 100  # random initial states, without rendering
    noise: NoNoise = field(default_factory=NoNoise)
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    folder: Path = Path("outputs/check")  # where the contact sheet goes
    tests: bool = True  # run the registry tests of this task, where this is a checkout

    def __post_init__(self):
        check(self)
        get_task(self.task)


def check_task(config: CheckTaskConfig) -> str:
    from lerobot_constructskill.analysis.stats.intervals import clopper_pearson
    from lerobot_constructskill.analysis.stats.outcomes import Counts

    sheet = save_contact_sheet(config)
    lengths, failures = measure_expert(config)
    _, low, high = clopper_pearson(Counts(config.states - len(failures), config.states))
    report = (
        f"{config.task}: the expert succeeds in {config.states - len(failures)} of {config.states} initial states "
        f"(95 % Clopper-Pearson {low:.1%} to {high:.1%}), in at most {max(lengths, default=0)} of "
        f"{get_task(config.task).horizon} steps. Look at {sheet}."
    )
    if len(failures) > (1 - REQUIRED) * config.states:
        raise InputError(f"{report} That is below {REQUIRED:.0%}; it failed at seeds {failures}.")
    if not config.tests or not (CHECKOUT / "pyproject.toml").is_file():
        return f"{report} Its tests were not run."
    if code := run_tests(config.task):
        raise InputError(f"{report} Its tests failed with status {code}; the output of pytest above says why.")
    return report


def measure_expert(config: CheckTaskConfig) -> tuple[list[int], list[int]]:
    """Lengths of the demonstrations that succeeded, in steps, and the seeds of those that did not."""
    from lerobot_constructskill.demos.demonstrate import demonstrate
    from lerobot_constructskill.demos.expert import make_expert
    from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
    from lerobot_constructskill.progress import Progress

    env = ConstructSkillEnv(config.task, render_backend="none")
    expert = make_expert(get_task(config.task), config.expert)
    lengths, failures = [], []
    for seed in Progress(range(DEMO_SEED_START, DEMO_SEED_START + config.states), "expert", unit="state"):
        frames, success = demonstrate(env, expert, config.noise, seed)
        if success:
            lengths.append(len(frames))
        else:
            failures.append(seed)
    env.close()
    return lengths, failures


def save_contact_sheet(config: CheckTaskConfig) -> Path:
    """Save the start of each phase and the end, the policy's view above a close-up, and return the picture's path."""
    import numpy as np
    from PIL import Image

    from lerobot_constructskill.demos.demonstrate import demonstrate
    from lerobot_constructskill.demos.expert import make_expert
    from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
    from lerobot_constructskill.progress import Progress

    env = ConstructSkillEnv(config.task)
    expert = make_expert(get_task(config.task), config.expert)
    columns = {}

    def keep(phase, obs):
        bar.update()
        if phase not in columns:
            columns[phase] = (obs["pixels"]["base"], env.render())

    with Progress(desc="contact sheet", unit="step") as bar:
        demonstrate(env, expert, NoNoise(), DEMO_SEED_START, watch=keep)
    env.close()
    tiles = [[np.asarray(Image.fromarray(image).resize((TILE, TILE))) for image in pair] for pair in columns.values()]
    path = config.folder / f"{config.task}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate([np.concatenate(pair) for pair in tiles], axis=1)).save(path)
    return path


def run_tests(task: str) -> int:
    """Exit status of every test that names `task`."""
    command = [sys.executable, "-m", "pytest", "-q", "-k", f"[{task}]", "tests"]
    return subprocess.run(command, check=False, cwd=CHECKOUT).returncode


def main() -> None:
    run(CheckTaskConfig, check_task)


if __name__ == "__main__":
    main()
