"""A round into a LeRobotDataset: an episode, a shard; what a killed run finished is not driven again."""

import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.artifacts.disk import room_for
from lerobot_constructskill.artifacts.folders import staged
from lerobot_constructskill.artifacts.store import Store
from lerobot_constructskill.dagger.plan import Plan
from lerobot_constructskill.dagger.wheel import Drive, Episode, drive_all
from lerobot_constructskill.demos.columns import EXPERT, dagger_features
from lerobot_constructskill.demos.expert import make_expert
from lerobot_constructskill.demos.merge import aggregate
from lerobot_constructskill.demos.shards import EPISODE, whole, write_episode
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.files import Json
from lerobot_constructskill.progress import quiet
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.training.trainers import trainer_of

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
    def of(cls, episode: Episode) -> "DrivenEpisode":
        by_expert = sum(frame["dagger.actor"] == EXPERT for frame in episode.frames)
        return cls(episode.seed, episode.placed, len(episode.frames), by_expert)


DRIVEN = Json("a round's episodes", list[DrivenEpisode])


def obtain_round(plan: Plan, number: int, store: Store) -> tuple[LeRobotDataset, list[DrivenEpisode]]:
    """A round's frames and outcomes, in the order of its seeds; driven if they are not there.

    Raises:
        InputError: no episode of it has a frame.
        OSError: the disk is full, this machine cannot render, or a simulator died.
    """
    made = plan.round(number)
    repo_id = f"local/{made.digest}"
    folder = store.obtain(made, lambda folder: _write_round(plan, number, repo_id, folder, store), keep=SHARDS)
    return LeRobotDataset(repo_id, root=folder), DRIVEN.read(folder / OUTCOMES)


def obtain_evaluation(plan: Plan, number: int, store: Store) -> list[DrivenEpisode]:
    """How policy `number` does in every evaluation episode by itself."""

    def make(folder: Path) -> None:
        never = plan.env["episode_length"] + 1  # nobody gives up for it
        alone = Drive(number, beta=0.0, patience=never, pictures=False)
        outcomes = [DrivenEpisode.of(episode) for episode in _drive(plan, number, plan.eval_seeds, alone, store)]
        folder.mkdir()
        _save(sorted(outcomes, key=lambda outcome: outcome.seed), folder / OUTCOMES)

    return DRIVEN.read(store.obtain(plan.evaluation(number), make) / OUTCOMES)


def _write_round(plan: Plan, number: int, repo_id: str, folder: Path, store: Store) -> None:
    shards = folder.with_name(SHARDS)
    finished = {outcome.seed for outcome in whole(shards, OUTCOME, _read_one)}
    seeds = [seed for seed in plan.seeds(number) if seed not in finished]
    features = dagger_features(plan.task, plan.base.obs_type)
    drive = Drive(number, plan.config.beta(number), plan.config.patience)
    for episode in _drive(plan, number - 1, seeds, drive, store):
        with staged(shards / str(episode.seed)) as shard:
            shard.mkdir()
            if episode.frames:
                write_episode(repo_id, plan.task, features, episode.frames, shard / EPISODE, plan.base.video)
            _save([DrivenEpisode.of(episode)], shard / OUTCOME)
    outcomes = [outcome for seed in plan.seeds(number) for outcome in DRIVEN.read(shards / str(seed) / OUTCOME)]
    roots = [shards / str(outcome.seed) / EPISODE for outcome in outcomes if outcome.frames]
    if not roots:
        raise InputError(f"Round {number} has no frame in which the expert knew a way to success.")
    with tempfile.TemporaryDirectory(dir=shards) as scratch, quiet(), room_for(folder):
        aggregate(repo_id, roots, folder, Path(scratch))
    _save(outcomes, folder / OUTCOMES)


def _drive(plan: Plan, policy: int, seeds: Iterable[int], drive: Drive, store: Store) -> Iterator[Episode]:
    here = {name: getattr(plan.policy, name) for name in trainer_of(plan.policy).places}
    checkpoint = store.folder(plan.checkpoint(policy))
    learner = PolicyAgent.from_pretrained(checkpoint, plan.policy.device, **here)
    expert = make_expert(plan.task, plan.base.expert)
    yield from drive_all(learner, expert, plan.env, seeds, drive, plan.config.together, plan.config.workers)


def _save(outcomes: Iterable[DrivenEpisode], path: Path) -> None:
    path.write_text(json.dumps([asdict(outcome) for outcome in outcomes]) + "\n", encoding="utf-8")


def _read_one(path: Path) -> DrivenEpisode:
    (outcome,) = DRIVEN.read(path)
    return outcome


def totals(outcomes: Iterable[DrivenEpisode]) -> Mapping[str, Any]:
    """What a line, and the provenance, say of a round's outcomes."""
    outcomes = list(outcomes)
    return {
        "episodes": len(outcomes),
        "placed": sum(outcome.placed for outcome in outcomes),
        "frames": sum(outcome.frames for outcome in outcomes),
        "by_expert": sum(outcome.by_expert for outcome in outcomes),
        "discarded_seeds": [outcome.seed for outcome in outcomes if not outcome.frames],
    }
