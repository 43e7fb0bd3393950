"""Shards: the folder of an attempt, with its outcome and, if it succeeded, a data set of one episode."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from lerobot_constructskill.artifacts.folders import staged
from lerobot_constructskill.contract import FPS, Task
from lerobot_constructskill.demos.columns import demonstration_features
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import make_expert
from lerobot_constructskill.demos.pixels import running_statistics
from lerobot_constructskill.demos.settings import GenerateConfig
from lerobot_constructskill.demos.video import VIDEOS
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import MachineError
from lerobot_constructskill.files import Json
from lerobot_constructskill.progress import quiet

OUTCOME = "attempt.json"
EPISODE = "episode"

LATE = (
    "An episode's video was not ready within LeRobot's two minutes: the machine stood still, or has too much to do. "
    "The same command goes on."
)


@dataclass(frozen=True)
class Attempt:
    """The outcome of one seed.

    Args:
        seed: of the environment and of the noise.
        success: whether the object was placed.
        frames: steps taken.
        light_robot: whether the robot was drawn with decimated meshes.
        backend: what simulated and rendered the attempt.
    """

    seed: int
    success: bool
    frames: int
    light_robot: bool
    backend: str


ATTEMPT = Json("an attempt's outcome", Attempt)


@dataclass
class Block:
    """The attempts at one task's demonstrations.

    Args:
        config: the settings of this task alone.
        shards: the folder of their shards.
        attempts: the outcomes, in the end in the order of their seeds.
    """

    config: GenerateConfig
    shards: Path
    attempts: list[Attempt] = field(default_factory=list)

    @property
    def demonstrations(self) -> list[Path]:
        """The data set of each attempt that succeeded."""
        return [self.shards / str(attempt.seed) / EPISODE for attempt in self.attempts if attempt.success]

    @property
    def discarded(self) -> list[int]:
        """Seeds of the attempts that failed."""
        return [attempt.seed for attempt in self.attempts if not attempt.success]


def attempt(config: GenerateConfig, seed: int, folder: Path) -> Attempt:
    """Run the attempt of `seed` and write its shard `folder/<seed>`, whole or not at all.

    Raises:
        FileExistsError: the shard exists, or another process is writing it.
        OSError: this machine cannot render.
    """
    (task,) = config.rows
    expert = make_expert(task, config.expert)
    env = _environment(task.name, config.obs_type, config.max_steps, config.light_robot, config.seen, config.action)
    frames, success = demonstrate(env, expert, config.noise, seed, config.labels, config.stop_at_success)
    outcome = Attempt(seed, success, len(frames), env.light_robot, env.backend)
    with staged(folder / str(seed)) as shard:
        shard.mkdir()
        if success:
            features = demonstration_features(task, config.seen, config.state)
            write_episode(config.repo_id, task, features, frames, shard / EPISODE, config.video)
        (shard / OUTCOME).write_text(json.dumps(asdict(outcome)), encoding="utf-8")
    return outcome


_open: dict[tuple, ConstructSkillEnv] = {}
"""The simulator of this process, by its arguments: one, because each takes memory."""


def _environment(
    task: str, obs_type: str, max_steps: int, light_robot: bool | None, cameras: tuple[str, ...], action: str
) -> ConstructSkillEnv:
    """The simulator of this process. Its episodes do not depend on each other; a new one compiles shaders for 6 s."""
    arguments = task, obs_type, max_steps, light_robot, cameras, action
    if arguments not in _open:
        while _open:  # that of the task before
            _open.popitem()[1].close()
        _open[arguments] = ConstructSkillEnv(*arguments[:4], cameras=cameras, action=action)
    return _open[arguments]


def whole[Kind](folder: Path, outcome: str, read: Callable[[Path], Kind]) -> list[Kind]:
    """The outcome of each shard in `folder`, as `read` returns it.

    A shard whose outcome cannot be read, because of a power cut or another version of this package, is removed.
    """
    found = []
    for path in sorted(folder.glob(f"*/{outcome}")):
        try:
            found.append(read(path))
        except ValueError:
            shutil.rmtree(path.parent)
    return found


def write_episode(
    repo_id: str, task: Task, features: dict[str, dict], frames: list[dict], root: Path, video: str
) -> None:
    """Write a data set of one episode.

    Args:
        features: its columns, as `columns` lists them.
        frames: their values, in order.
        video: an entry of `VIDEOS`.

    Raises:
        MachineError: the machine stood still, and LeRobot did not wait for a video any longer.
    """
    import av
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets import LeRobotDataset

    from lerobot_constructskill.lerobot_internals import patched

    os.environ.setdefault("SVT_LOG", "1")
    # The rows hold no pictures to embed, for which LeRobot would go through them one by one: there are videos.
    as_they_are = patched("embed_images", lambda rows: rows)
    with quiet(), as_they_are, patched("RunningQuantileStats", running_statistics()):
        dataset = LeRobotDataset.create(
            repo_id=repo_id,
            root=root,
            fps=FPS,
            robot_type="panda",
            features=features,
            rgb_encoder=RGBEncoderConfig(**VIDEOS[video].encoder),
            streaming_encoding=True,
            # A demonstration is written at once; a shorter queue would drop frames that the encoder is late for.
            encoder_queue_maxsize=max(len(frames), 1),
        )
        for frame in frames:
            dataset.add_frame(frame | {"task": task.instruction})
        # After two minutes LeRobot takes what there is of a video: perhaps nothing, perhaps all but its statistics.
        try:
            dataset.save_episode()
        except (av.InvalidDataError, FileNotFoundError) as error:
            raise MachineError(LATE) from error
        if len(frames) > 1 and not {*dataset.meta.video_keys} <= {*dataset.meta.stats}:
            raise MachineError(LATE)
        dataset.finalize()
