"""Commands about the scripted expert of a task: `constructskill-film` and `constructskill-check-task`."""

from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.bounds import Among, Checked, Count, Seed
from lerobot_constructskill.contract import DEMO_SEED_START, FPS, get_task, label_of
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, make_expert
from lerobot_constructskill.demos.noise import NoiseConfig, Sigma
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.progress import Progress, quiet
from lerobot_constructskill.scripts.console import command

REQUIRED = 0.95
"""Share of random initial states in which an expert must succeed."""


@dataclass(frozen=True)
class NoNoise(NoiseConfig):
    """`NoiseConfig` for commands that add no noise by default; draccus takes no default from a field's value.

    Args:
        sigma: standard deviation per axis of `fixed`, in metres; none by default.
    """

    sigma: Sigma = 0.0


View = Annotated[str, Among(("close", "policy"))]


@dataclass
class FilmConfig(Checked):
    """Film the scripted expert of a task in one episode, by default without noise."""

    task: str = "brick_to_bin"  # a name in `contract.TASKS`
    out: Path | None = None  # the video; default: outputs/<task>.mp4
    view: View = "close"  # a close-up (close), or what the policy sees (policy)
    seed: Seed = DEMO_SEED_START  # decides the initial state and the noise
    noise: NoNoise = field(default_factory=NoNoise)
    perturb: str = ""  # axis=level, separated by commas, as in the environment
    perturb_seed: Seed = 0  # of what a perturbation draws once

    def __post_init__(self):
        super().__post_init__()
        if self.out is not None and self.out.suffix != ".mp4":
            raise InputError(f"out must be a file that ends in .mp4, not '{self.out}'.")


@command("constructskill-film brick_on_brick", first=("task",))
def film(config: FilmConfig) -> str:
    """Write the video and return a line that says where, and how the episode ended.

    Raises:
        InputError: there is no such task, view or perturbation.
        OSError: there is nothing to render with, or the video cannot be written.
    """
    from lerobot_constructskill.lerobot_internals import write_video

    out = config.out or Path("outputs") / f"{label_of(config.task)}.mp4"
    expert = make_expert(get_task(config.task), ExpertConfig())
    frames = []

    def watch(phase, obs):
        frames.append(env.render() if config.view == "close" else obs["pixels"]["base"])
        bar.update()

    made = ConstructSkillEnv(config.task, perturb=config.perturb, perturb_seed=config.perturb_seed, film=True)
    with (
        closing(made) as env,
        Progress(desc=f"filming {config.task}", unit="step") as bar,
    ):
        _, success = demonstrate(env, expert, config.noise, config.seed, watch=watch)
    with replaced(out) as partial, quiet():
        write_video(partial, frames, FPS)
    return f"{out}: {len(frames) / FPS:.0f} s, {'placed' if success else 'not placed'}"


@dataclass
class CheckTaskConfig(Checked):
    """Measure the expert of one task of the contract table in random initial states."""

    task: str  # a name in `contract.TASKS`
    states: Count = 100  # random initial states, without rendering
    noise: NoNoise = field(default_factory=NoNoise)
    expert: ExpertConfig = field(default_factory=ExpertConfig)


@command("constructskill-check-task --task=brick_on_brick --states=20")
def check_task(config: CheckTaskConfig) -> str:
    """Measure the expert and return the outcome in a sentence.

    Raises:
        InputError: there is no such task, or its expert succeeds too seldom.
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
    lengths, failures = [], []
    with closing(ConstructSkillEnv(config.task, render_backend="none")) as env:
        for seed in Progress(range(DEMO_SEED_START, DEMO_SEED_START + config.states), "expert", unit="state"):
            frames, success = demonstrate(env, expert, config.noise, seed)
            if success:
                lengths.append(len(frames))
            else:
                failures.append(seed)
    return lengths, failures
