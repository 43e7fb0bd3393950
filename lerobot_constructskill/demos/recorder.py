"""Demonstrations into a LeRobotDataset: seeds in order, failures discarded and counted, all or nothing on disk."""

import json
import os
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path

from tqdm import tqdm

from lerobot_constructskill.contract import DEMO_SEED_START, FPS, OBS_TYPES, get_task
from lerobot_constructskill.demos.expert import ExpertConfig
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.staging import staged


@dataclass(frozen=True)
class GenerateConfig:
    """A data set of scripted demonstrations.

    Args:
        repo_id: the data set's name, `user/name`.
        root: folder to write; `$HF_LEROBOT_HOME/<repo_id>` by default. It must not exist.
        task: a name in `contract.TASKS`.
        episodes: successful demonstrations to record.
        obs_type: `pixels` (the paper's sole view) or `pixels_agent_pos` (adds the wrist view). The state is always
            recorded.
        max_steps: steps after which an attempt counts as failed.
        max_failures: failed attempts, as a fraction of `episodes`, at which the run gives up.
        seed_start: seed of the first attempt; attempt i has seed `seed_start + i`.
        light_robot: as in the environment.
        expert: gains, thresholds and dwells.
        noise: what is added to the executed action.

    Raises:
        ValueError: unknown task or obs_type, or a count below 1.
    """

    repo_id: str
    root: str | None = None
    task: str = "brick_to_bin"
    episodes: int = 80
    obs_type: str = "pixels"
    max_steps: int = 1000
    max_failures: float = 1.0
    seed_start: int = DEMO_SEED_START
    light_robot: bool | None = None
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)

    def __post_init__(self):
        get_task(self.task)
        if self.obs_type not in OBS_TYPES:
            raise ValueError(f"Unknown obs_type '{self.obs_type}'; choose one of: {', '.join(OBS_TYPES)}.")
        for name in ("episodes", "max_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}.")


@dataclass(frozen=True)
class Summary:
    """What a generation did: where the data set is, its sizes, and the seeds that were discarded."""

    root: Path
    episodes: int
    frames: int
    discarded_seeds: list[int]


def record(config: GenerateConfig) -> Summary:
    """Write the data set of `config`; an interrupted run leaves no data set, and the next one starts clean.

    Raises:
        FileExistsError: the root exists already, or another process is writing it.
        ValueError: more attempts failed than `max_failures` allows.
        OSError: this machine cannot render.
    """
    from lerobot.utils.constants import HF_LEROBOT_HOME

    root = Path(config.root) if config.root else HF_LEROBOT_HOME / config.repo_id
    with staged(root) as folder:
        return _record_into(config, folder, root)


def _record_into(config: GenerateConfig, folder: Path, root: Path) -> Summary:
    from lerobot_constructskill.demos.columns import SIDECAR
    from lerobot_constructskill.demos.demonstrate import demonstrate
    from lerobot_constructskill.demos.expert import make_expert
    from lerobot_constructskill.envs.gym_env import ConstructSkillEnv

    task = get_task(config.task)
    expert = make_expert(task, config.expert)
    env = ConstructSkillEnv(config.task, config.obs_type, config.max_steps, config.light_robot)
    env.reset(seed=config.seed_start)  # a machine that cannot render fails here, before anything is written
    dataset = _create_dataset(config, folder)
    discarded, seed = [], config.seed_start
    with tqdm(total=config.episodes, desc="demonstrations", unit="demo") as bar:
        while dataset.num_episodes < config.episodes:
            frames, success = demonstrate(env, expert, config.noise, seed)
            if success:
                for frame in frames:
                    dataset.add_frame(frame | {"task": task.instruction})
                dataset.save_episode()
                bar.update()
            else:
                discarded.append(seed)
                bar.set_postfix(discarded=len(discarded))
                _check_failures(config, discarded)
            seed += 1
    dataset.finalize()
    facts = _provenance(config, env, discarded)
    (folder / SIDECAR).write_text(json.dumps(facts, indent=2) + "\n")
    env.close()
    return Summary(root, dataset.num_episodes, dataset.num_frames, discarded)


def _create_dataset(config: GenerateConfig, folder: Path):
    import av
    import datasets
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_constructskill.demos.columns import demonstration_features

    # One progress bar is enough: these print one for every demonstration.
    datasets.disable_progress_bars()
    av.logging.set_libav_level(av.logging.ERROR)
    os.environ.setdefault("SVT_LOG", "1")
    return LeRobotDataset.create(
        repo_id=config.repo_id,
        root=folder,
        fps=FPS,
        robot_type="panda",
        features=demonstration_features(get_task(config.task), config.obs_type),
        rgb_encoder=RGBEncoderConfig(crf=18),
        streaming_encoding=True,
        # A demonstration is written at once; a shorter queue would drop frames that the encoder is late for.
        encoder_queue_maxsize=config.max_steps,
    )


def _check_failures(config: GenerateConfig, discarded: list[int]) -> None:
    if len(discarded) > config.max_failures * config.episodes:
        raise ValueError(
            f"{len(discarded)} attempts failed, more than max_failures={config.max_failures} allows for "
            f"{config.episodes} demonstrations: check the expert's and the noise's values."
        )


def _provenance(config: GenerateConfig, env, discarded: list[int]) -> dict:
    facts = asdict(config)
    del facts["root"]
    packages = ("lerobot_env_constructskill", "lerobot", "mani_skill", "sapien", "torch", "numpy")
    return {
        "generator": facts | {"light_robot": env.light_robot},
        "attempts": config.episodes + len(discarded),
        "discarded_seeds": discarded,
        "versions": {name: version(name) for name in packages},
    }
