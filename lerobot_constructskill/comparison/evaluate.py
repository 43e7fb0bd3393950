"""Evaluates checkpoints of any LeRobot policy where the other side was evaluated."""

from collections.abc import Mapping, Sequence
from itertools import batched
from pathlib import Path
from typing import Any

from lerobot_constructskill.comparison.sides import Side, Source, conditions, recorded_side
from lerobot_constructskill.contract import label_of
from lerobot_constructskill.envs.recording import write_recordings
from lerobot_constructskill.errors import InputError, one_line, plural
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.rollout.lockstep import roll_out
from lerobot_constructskill.training.checkpoints import check_inputs


def evaluate(
    source: Source,
    env: Mapping[str, Any],
    starts: Sequence[int],
    together: int,
    device: str | None = None,
    kept_in: Path | None = None,
) -> Side:
    """Run every checkpoint through an episode from each start.

    Args:
        source: folders of checkpoints, one for each training seed.
        env: keyword arguments of `ConstructSkillEnv`.
        starts: seeds of the episodes.
        together: number of policies in memory at a time.
        device: device in place of the one in the checkpoints.
        kept_in: folder for recordings, with a folder for each checkpoint; none are kept by default.

    Raises:
        InputError: a checkpoint cannot be loaded, reads an observation that it would not get, or failed in an episode.
        OSError: a simulator's process died.
    """
    perturbation = {"perturb": env.get("perturb") or "", "perturb_seed": env.get("perturb_seed") or 0}
    facts = conditions(env) | perturbation
    by_folder = {}
    for group in batched(source.folders, together):  # noqa: B911  the last one may be smaller
        agents = [PolicyAgent.from_pretrained(checkpoint, device) for checkpoint in group]
        env = {**env, "action": agents[0].action}
        for checkpoint, agent in zip(group, agents, strict=True):
            try:
                check_inputs(agent.policy.config, facts["obs_type"])
            except InputError as error:
                raise InputError(f"'{checkpoint}': {error}") from None
        rollouts = dict(roll_out(agents, env, [starts] * len(agents)))
        for number, checkpoint in enumerate(group):
            if (error := rollouts[number].error) is not None:
                said = one_line(f"{type(error).__name__}: {error}")
                raise InputError(f"The checkpoint '{checkpoint}' failed in its evaluation ({said}).") from error
            recordings = by_folder[checkpoint] = rollouts[number].recordings(facts)
            if kept_in is not None:
                file = f"{label_of(facts['task'])}_{facts['episode_length']}{facts['perturbation']}.parquet"
                write_recordings(recordings, kept_in / f"{len(by_folder) - 1:02d}_{_label(checkpoint)}" / file)
    return recorded_side(source.name, f"{plural(len(by_folder), 'checkpoint')}, evaluated now", by_folder)


def _label(checkpoint: Path) -> str:
    """Name of the folder that tells a checkpoint from those of other seeds, such as seed_0."""
    parts = checkpoint.absolute().parts
    return [part for part in parts if part not in ("checkpoints", "last", "pretrained_model")][-1]
