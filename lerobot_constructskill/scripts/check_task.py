"""`constructskill-check-task`: measure the expert of a new task."""

from dataclasses import dataclass, field

from lerobot_constructskill.bounds import Checked, Count
from lerobot_constructskill.contract import DEMO_SEED_START, get_task
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, make_expert
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.progress import Progress
from lerobot_constructskill.scripts.console import run
from lerobot_constructskill.scripts.film import NoNoise

REQUIRED = 0.95
"""Share of random initial states in which an expert must succeed."""


@dataclass
class CheckTaskConfig(Checked):
    """Measure the expert of one task of the contract table in random initial states."""

    task: str  # a name in `contract.TASKS`
    states: Count = 100  # random initial states, without rendering
    noise: NoNoise = field(default_factory=NoNoise)
    expert: ExpertConfig = field(default_factory=ExpertConfig)


def check_task(config: CheckTaskConfig) -> str:
    """Measure, and return the outcome in a sentence.

    Raises:
        ValueError: there is no such task, or its expert succeeds too seldom.
    """
    from lerobot_constructskill.analysis.stats.intervals import clopper_pearson
    from lerobot_constructskill.analysis.stats.outcomes import Counts

    lengths, failures = measure_expert(config)
    _, low, high = clopper_pearson(Counts(len(lengths), config.states))
    report = (
        f"{config.task}: the expert succeeds in {len(lengths)} of {config.states} initial states "
        f"(95 % Clopper-Pearson {low:.1%} to {high:.1%}), in at most {max(lengths, default=0)} of "
        f"{get_task(config.task).horizon} steps. "
        f"`constructskill-film --task={config.task} --view=policy` shows what a policy sees."
    )
    if len(failures) > (1 - REQUIRED) * config.states:
        raise InputError(f"{report} That is below {REQUIRED:.0%}; it failed at seeds {failures}.")
    return report


def measure_expert(config: CheckTaskConfig) -> tuple[list[int], list[int]]:
    """Lengths of the demonstrations that succeeded, in steps, and the seeds of those that did not."""
    expert = make_expert(get_task(config.task), config.expert)
    env = ConstructSkillEnv(config.task, render_backend="none")
    lengths, failures = [], []
    for seed in Progress(range(DEMO_SEED_START, DEMO_SEED_START + config.states), "expert", unit="state"):
        frames, success = demonstrate(env, expert, config.noise, seed)
        if success:
            lengths.append(len(frames))
        else:
            failures.append(seed)
    env.close()
    return lengths, failures


def main() -> None:
    run(CheckTaskConfig, check_task)
