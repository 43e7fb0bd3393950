"""Checkpoints of any LeRobot policy, evaluated where the other side was."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import batched
from pathlib import Path
from typing import Any

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import versions
from lerobot_constructskill.artifacts.processor import make, processor
from lerobot_constructskill.comparison.sides import MAKER, Conditions, Side, merge_versions
from lerobot_constructskill.envs.recording import RECORDINGS, write_recordings
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.rollout.lockstep import Rollout, roll_out
from lerobot_constructskill.training.checkpoints import ACTING, check_inputs
from lerobot_constructskill.training.trainers import versions_of


def evaluate(
    name: str,
    checkpoints: Sequence[Path],
    env: Mapping[str, Any],
    starts: Sequence[int],
    together: int,
    device: str | None = None,
    kept_in: Path | None = None,
) -> Side:
    """Run every checkpoint through an episode from each start.

    Args:
        name: what the side is called.
        checkpoints: folders of checkpoints, one for each training seed.
        env: keyword arguments of `ConstructSkillEnv`.
        starts: seeds of the episodes.
        together: policies that are in memory at a time.
        device: in place of the one in the checkpoints.
        kept_in: folder for recordings, in one folder for each checkpoint; none are kept by default.

    Raises:
        InputError: a checkpoint cannot be loaded, reads what it would not be shown, or failed in an episode.
        OSError: a simulator's process died.
    """
    seeds, told = [], []
    for group in batched(checkpoints, together):  # noqa: B911  the last one may be smaller
        for checkpoint, agent, rollout in _roll_out(group, env, starts, device):
            seeds.append({episode.evaluation_seed: episode.placed for episode in rollout.episodes})
            packages = versions(*ACTING) | code_of(roll_out.__module__) | versions_of(agent.policy.config)
            told.append(packages | {"processor": processor(), MAKER: make(), "backend": rollout.backend})
            if kept_in is not None:
                folder = kept_in / f"{len(seeds) - 1:02d}_{_label(checkpoint)}"
                write_recordings(rollout.recordings(vars(Conditions.of(env))), folder / RECORDINGS)
    kind = f"{plural(len(checkpoints), 'checkpoint')}, evaluated now"
    return Side(name, kind, env, seeds, merge_versions(told))


def _roll_out(
    checkpoints: Sequence[Path], env: Mapping[str, Any], starts: Sequence[int], device: str | None
) -> Iterator[tuple[Path, PolicyAgent, Rollout]]:
    agents = [PolicyAgent.from_pretrained(checkpoint, device) for checkpoint in checkpoints]
    for checkpoint, agent in zip(checkpoints, agents, strict=True):
        try:
            check_inputs(agent.policy.config, Conditions.of(env).obs_type)
        except InputError as error:
            raise InputError(f"'{checkpoint}': {error}") from None
    rollouts = dict(roll_out(agents, env, starts))  # each as it ends
    for number, (checkpoint, agent) in enumerate(zip(checkpoints, agents, strict=True)):
        if (error := rollouts[number].error) is not None:
            said = " ".join(f"{type(error).__name__}: {error}".split())
            raise InputError(f"The checkpoint '{checkpoint}' failed where it is evaluated ({said}).") from error
        yield checkpoint, agent, rollouts[number]


def _label(checkpoint: Path) -> str:
    """The folder that tells a checkpoint from those of other seeds, such as seed_0."""
    names = [part for part in checkpoint.absolute().parts if part not in ("checkpoints", "last", "pretrained_model")]
    return names[-1]
