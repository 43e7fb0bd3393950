"""A round of DAgger in one task as a node of a store: the episodes that a policy drives, as a LeRobotDataset."""

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import file_sha256, versions
from lerobot_constructskill.artifacts.disk import room_for
from lerobot_constructskill.artifacts.folders import staged
from lerobot_constructskill.artifacts.store import Machine, Node
from lerobot_constructskill.contract import Task, get_task
from lerobot_constructskill.dagger.driving import Drive, RunningEpisode, drive_all
from lerobot_constructskill.demos.columns import EXPERT, dagger_features
from lerobot_constructskill.demos.expert import make_expert
from lerobot_constructskill.demos.merge import aggregate, name_tasks
from lerobot_constructskill.demos.node import Demonstrations
from lerobot_constructskill.demos.shards import EPISODE, whole, write_episode
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.files import Json
from lerobot_constructskill.progress import quiet
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.training.checkpoints import ACTING, Checkpoints, checkpoint_of

DRIVING = (*ACTING, "av")
"""Packages whose versions may show in a round's frames, beside the policy's own."""

SHARDS = "shards"
OUTCOME, OUTCOMES = "outcome.json", "outcomes.json"


@dataclass(frozen=True)
class DrivenEpisode:
    """What a round keeps of an episode that a policy drove.

    Args:
        seed: of its initial state.
        placed: whether the object was placed.
        frames: kept frames, each with the expert's label; none where the expert knew no way from the start.
        by_expert: frames in which the expert's action was executed.
    """

    seed: int
    placed: bool
    frames: int
    by_expert: int

    @classmethod
    def of(cls, episode: RunningEpisode) -> "DrivenEpisode":
        by_expert = sum(frame["dagger.actor"] == EXPERT for frame in episode.frames)
        return cls(episode.seed, episode.placed, len(episode.frames), by_expert)


@dataclass(frozen=True)
class Driven:
    """What is kept of all episodes that a policy drove.

    Args:
        policy_sha256: hash of the policy's weights; None where they are in no `model.safetensors`.
        episodes: in the order of their seeds.
    """

    policy_sha256: str | None
    episodes: list[DrivenEpisode]


ONE, DRIVEN = Json("a driven episode", DrivenEpisode), Json("a round's episodes", Driven)


@dataclass(frozen=True, eq=False)
class Round(Node):
    """Episodes of one task in which a policy drives and the expert labels every frame; a LeRobotDataset.

    Args:
        policy: one checkpoint.
        base: the demonstrations, for their action, their expert and their video encoding.
        env: keywords of `ConstructSkillEnv`, the task among them.
        seeds: seeds of the initial states.
        number: the round's number, counted from 1.
        beta: probability that a step executes the expert's action.
        patience: hopeless steps in a row after which an episode ends.
    """

    policy: Checkpoints
    base: Demonstrations
    env: Mapping[str, Any]
    seeds: range
    number: int
    beta: float
    patience: int

    kind = "rounds"
    keeps = SHARDS

    @property
    def task(self) -> Task:
        """The task, whose action is that of the base."""
        return get_task(self.env["task"], self.base.config.action)

    @property
    def is_of_several(self) -> bool:
        """Whether the base has other tasks too, each with rounds of its own."""
        return len(self.base.config.rows) > 1

    def facts(self) -> dict[str, Any]:
        base, seeds = self.base.config, [self.seeds.start, self.seeds.stop]
        how = {"number": self.number, "beta": self.beta, "patience": self.patience}
        return how | {"seeds": seeds, "environment": self.env, "expert": vars(base.expert), "video": base.video}

    def versions(self) -> dict[str, str]:
        own = code_of(__name__, self.task.scene, self.task.expert)
        return versions(*DRIVING) | own | self.policy.learner.versions()

    @cached_property
    def inputs(self) -> dict[str, Node]:
        return {"policy": self.policy}

    def make(self, folder: Path, inputs: Mapping[str, Path], machine: Machine) -> None:
        """Drive the round; each episode is a shard. Shards that a killed run finished are not driven again.

        Raises:
            InputError: no episode has a frame.
            MachineError: the disk is full, this machine cannot render, or a simulator died.
        """
        shards, config = folder.with_name(SHARDS), self.base.config
        task, repo_id = self.task, self.repo_id
        checkpoint = checkpoint_of(self.policy.seeds.start, inputs["policy"])
        finished = {outcome.seed for outcome in whole(shards, OUTCOME, ONE.read)}
        for episode in self._drive(checkpoint, [seed for seed in self.seeds if seed not in finished], machine):
            with staged(shards / str(episode.seed)) as shard:
                shard.mkdir()
                if episode.frames:
                    features = dagger_features(task, config.seen, config.state)
                    write_episode(repo_id, task, features, episode.frames, shard / EPISODE, config.video)
                outcome = json.dumps(asdict(DrivenEpisode.of(episode)))
                (shard / OUTCOME).write_text(outcome + "\n", encoding="utf-8")
        outcomes = [ONE.read(shards / str(seed) / OUTCOME) for seed in self.seeds]
        roots = [shards / str(outcome.seed) / EPISODE for outcome in outcomes if outcome.frames]
        if not roots:
            of = f" of {task.name}" if self.is_of_several else ""
            raise InputError(f"Round {self.number}{of} has no frame in which the expert knew a way to success.")
        with tempfile.TemporaryDirectory(dir=shards) as scratch, quiet(), room_for(folder):
            aggregate(repo_id, roots, folder, Path(scratch))
        if self.is_of_several:
            name_tasks(folder, [task.name] * len(roots))
        weights = checkpoint / "model.safetensors"
        driven = Driven(file_sha256(weights) if weights.exists() else None, outcomes)
        (folder / OUTCOMES).write_text(json.dumps(asdict(driven)) + "\n", encoding="utf-8")

    def _drive(self, checkpoint: Path, seeds: Sequence[int], machine: Machine) -> Iterator[RunningEpisode]:
        agent = PolicyAgent.from_pretrained(checkpoint, **self.policy.learner.acting)
        expert = make_expert(self.task, self.base.config.expert)
        drive = Drive(self.number, self.beta, self.patience)
        yield from drive_all(agent, expert, self.env, seeds, drive, machine.together, machine.workers)


def totals(*folders: Path) -> dict[str, Any]:
    """Sums over the episodes of a round, of one task or of several, and the seeds of those without a frame."""
    outcomes = [outcome for folder in folders for outcome in DRIVEN.read(folder / OUTCOMES).episodes]
    return {
        "episodes": len(outcomes),
        "placed": sum(outcome.placed for outcome in outcomes),
        "frames": sum(outcome.frames for outcome in outcomes),
        "by_expert": sum(outcome.by_expert for outcome in outcomes),
        "discarded_seeds": [outcome.seed for outcome in outcomes if not outcome.frames],
    }
