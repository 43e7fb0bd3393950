"""The settings of `constructskill-generate`, and which of them decide the bytes of frames."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from itertools import combinations
from typing import Annotated, Any

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import digest, versions
from lerobot_constructskill.artifacts.pools import EXECUTORS
from lerobot_constructskill.bounds import Among, Count, Range, RepoId, Seed, Steps, Text, Workers, check
from lerobot_constructskill.contract import (
    ACTIONS,
    DEMO_SEED_START,
    OBS_TYPES,
    TASK_ACTION,
    Task,
    list_tasks,
    state_names,
)
from lerobot_constructskill.demos.columns import demonstration_features
from lerobot_constructskill.demos.expert import ExpertConfig
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.demos.video import VIDEOS
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.plans.plan import read_plan

LABELS = ("clean", "executed", "advice")

STEPS_AN_ELEMENT = 250
"""Steps in which the expert lays an element of a plan, about."""

FRAME_PACKAGES = ("lerobot", "mani_skill", "sapien", "torch", "numpy", "av")
"""Packages whose versions may show in the frames."""


@dataclass(frozen=True)
class GenerateConfig:
    """A data set of scripted demonstrations.

    Args:
        repo_id: the data set's name, `user/name`.
        root: folder to write; `$HF_LEROBOT_HOME/<repo_id>` by default. It must not exist.
        task: a name in `contract.TASKS` or in `contract.SUITES`, or several with commas between: the data set then
            has their demonstrations one task after another, in this order.
        episodes: successful demonstrations to record, of each task.
        obs_type: `pixels` (the base camera) or `pixels_agent_pos` (adds the wrist camera). The state is always
            recorded; with `pixels_agent_pos_force` it has the force at the wrist too.
        cameras: those of `obs_type` that are rendered and recorded, such as `[wrist]`; all by default. One of two
            takes less time and disk.
        max_steps: steps after which an attempt counts as failed.
        max_failures: failed attempts at a task, as a fraction of `episodes`, above which the run gives up.
        seed_start: seed of the first attempt at each task; attempt i has seed `seed_start + i`.
        light_robot: draw the robot with decimated meshes, as in the environment.
        labels: what `action` holds: the expert's `clean` command (the paper), what was `executed` (MimicGen), or the
            expert's `advice` from the state alone, which labels DAgger's rounds.
        video: how frames are kept: `av1` (2 KB each, with a loss that fine features show) or `lossless` (HEVC, up to
            30 KB: every pixel as it was rendered; few browsers play it).
        stop_at_success: whether a demonstration ends with the placement (five steps in the bin), or only when the
            expert has finished: its last steps, the open hand above the bin, show when to let go.
        action: the channels of `action`: those of the `task`, or `full`, which tasks with and without rotations share;
            those that a task does not use are 0.
        annotate: whether LeRobot's language columns are written: the expert's subtasks, to the frame, and other words
            for the task.
        expert: its gains, thresholds and dwells (metres, steps).
        noise: what is added to the executed action (metres).
        workers: attempts that run at the same time; the data set does not depend on it.
        executor: what they run on: `processes` of this machine, or `ray` (extra `distributed`; a cluster needs `root`
            on a file system that all its machines share).

    Raises:
        ValueError: a field holds what its annotation does not allow, or there is no such task.
    """

    repo_id: RepoId
    root: Text | None = None
    task: str = "brick_to_bin"
    episodes: Count = 80
    obs_type: Annotated[str, Among(tuple(OBS_TYPES))] = "pixels"
    cameras: list[str] | None = None
    max_steps: Steps = 1000
    max_failures: Annotated[float, Range(0, 10_000)] = 1.0
    seed_start: Seed = DEMO_SEED_START
    light_robot: bool | None = None
    labels: Annotated[str, Among(LABELS)] = "clean"
    video: Annotated[str, Among(tuple(VIDEOS))] = "av1"
    stop_at_success: bool = True
    action: Annotated[str, Among(ACTIONS)] = TASK_ACTION
    annotate: bool = False
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    workers: Workers = 1
    executor: Annotated[str, Among(EXECUTORS)] = "processes"

    def __post_init__(self):
        check(self)
        self._check_plans()
        if self.cameras is not None and not (self.cameras and {*self.cameras} <= {*OBS_TYPES[self.obs_type]}):
            raise InputError(
                f"cameras must be some of {', '.join(OBS_TYPES[self.obs_type])}, which {self.obs_type} has, not "
                f"{', '.join(self.cameras) or 'none'}."
            )

    def _check_plans(self) -> None:
        """Refuse a task that there is not, plans that take longer than an attempt, and two of one sentence."""
        rows = self.rows
        for row in rows:
            elements = len(read_plan(row.plan).elements) if row.plan else 0
            if self.max_steps < elements * STEPS_AN_ELEMENT:
                most = STEPS_AN_ELEMENT + 100
                raise InputError(
                    f"{row.name} has {elements} elements, of which each takes about {STEPS_AN_ELEMENT} steps, with "
                    f"noise up to {most}: give max_steps={elements * most}, not {self.max_steps}."
                )
        asked = [row.instruction for row in rows if row.plan]
        if twice := next((one for one in asked if asked.count(one) > 1), None):
            raise InputError(f"Two plans of {self.task} are asked for by one sentence, {twice!r}: make a set of each.")

    @property
    def rows(self) -> list[Task]:
        """The tasks, whose actions are as asked for."""
        return list_tasks(self.task, self.action)

    @property
    def parts(self) -> list["GenerateConfig"]:
        """The settings of each task alone."""
        return [replace(self, task=row.name) for row in self.rows]

    @property
    def seen(self) -> tuple[str, ...]:
        """The cameras that are recorded."""
        offered = OBS_TYPES[self.obs_type]
        return tuple(name for name in offered if self.cameras is None or name in self.cameras)

    @property
    def state(self) -> tuple[str, ...]:
        """The channels of `observation.state`."""
        return state_names(self.obs_type)

    @property
    def starts(self) -> range:
        """Seeds of all attempts that the generation may make at each task."""
        return range(self.seed_start, self.seed_start + self.episodes + int(self.max_failures * self.episodes))


def check_apart(starts: Mapping[str, range]) -> None:
    """Refuse overlapping seeds.

    Args:
        starts: each use, such as "evaluation", and the seeds of its initial states.

    Raises:
        InputError: two uses share a seed.
    """
    for (one, these), (other, those) in combinations(starts.items(), 2):
        if max(these.start, those.start) < min(these.stop, those.stop):
            raise InputError(
                f"The {one} may have starts {these.start} to {these.stop - 1} and the {other} {those.start} to "
                f"{those.stop - 1}: no start may be in both (seed_start, eval_seed)."
            )


def generator_facts(config: GenerateConfig) -> dict[str, Any]:
    """The settings that a data set records: all but where and how fast it was generated."""
    facts = {name: value for name, value in asdict(config).items() if name not in ("root", "workers", "executor")}
    facts["task"] = ",".join(row.name for row in config.rows)  # a suite may get others
    # What is not asked for is left out, so that sets from before there was a choice keep their digests.
    left_out = {"cameras": not config.cameras, "action": config.action == TASK_ACTION, "annotate": not config.annotate}
    return {name: value for name, value in facts.items() if not left_out.get(name)}


def frames_digest(config: GenerateConfig) -> str:
    """Digest of everything that the bytes of frames depend on, so that no data set mixes shards of two kinds.

    The renderer is left out, because it is known only once a shard exists; `merge` refuses a mixture of renderers.
    """
    others = ("repo_id", "episodes", "max_failures", "seed_start", "annotate")
    facts = {name: value for name, value in generator_facts(config).items() if name not in others}
    return digest(facts | frame_facts(config) | {"versions": frame_versions(config)})


def frame_facts(config: GenerateConfig) -> dict[str, Any]:
    """The encoder's options, the columns and the plans, on which a data set depends beside its settings."""
    columns = demonstration_features(config.rows[0], config.seen, config.state)
    plans = {row.name: read_plan(row.plan).laid() for row in config.rows if row.plan is not None}
    if plans:
        plans = {"plans": plans} if len(config.rows) > 1 else {"plan": plans[config.rows[0].name]}
    return {"encoder": VIDEOS[config.video].encoder, "columns": digest(columns)} | plans


def frame_versions(config: GenerateConfig) -> dict[str, str]:
    """Versions that decide frames: packages, our rooms, and the source of another package's scene and expert."""
    made_by = [name for row in config.rows for name in (row.scene, row.expert)]
    return versions(*FRAME_PACKAGES) | code_of(*made_by, __name__)
