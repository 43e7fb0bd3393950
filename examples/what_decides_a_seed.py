"""Why do training seeds of a policy differ? Where each ends, what another's head changes, how far they disagree.

Usage: python examples/what_decides_a_seed.py results/paper outputs/store dinov2_vits14 outputs/seeds [SEEDS]

Reads the rows of a study and the checkpoints of its first SEEDS runs (10); writes `table.md`, and
`failing_and_succeeding.mp4` where there are both. Every seed acts as it is and with two other thresholds of the
gripper's logit; a seed that fails, with either head of the first seed that places, and that seed with each of theirs.
"""

import sys
from collections.abc import Mapping
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from films import side_by_side

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill.contract import FPS
from lerobot_constructskill.lerobot_internals import write_video
from lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit import FrozenViTChunkPolicy
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.rollout.lockstep import roll_out
from lerobot_constructskill.study.rows import read_rows

THRESHOLDS = (-0.5, 1.5)
"""Of the gripper's logit, beside the paper's 0.5."""

HEADS = ("translation", "gripper")


class Watched:
    """An episode: its stage, where the hand was last, and what the policy saw."""

    def __init__(self):
        self.stage, self.hand, self.frames = "", np.zeros(3), []


def main(results: str, store: str, variant: str, out: str, seeds: str = "10") -> None:
    env = next(iter(yaml.safe_load((Path(results) / "study.yaml").read_text())["settings"].values()))["env"]
    rows = read_rows(Path(results) / "rows.parquet").query("variant == @variant and error.isna()")
    runs = rows.drop_duplicates("training_seed").set_index("training_seed").run.sort_index().head(int(seeds))
    folders = {seed: Path(store) / "runs" / run / "checkpoint" for seed, run in runs.items()}
    agents = {seed: PolicyAgent.from_pretrained(folder) for seed, folder in folders.items()}

    plain = play(agents, env)
    placed = [seed for seed, episode in plain.items() if episode.stage == "placed"]
    failed = [seed for seed in plain if seed not in placed]
    changed = {}
    for seed, agent in agents.items():
        for value in THRESHOLDS:
            changed[seed, f"threshold {value:g}"] = thresholded(agent, value)
    for seed in failed if placed else []:
        for head in HEADS:
            changed[seed, f"{head} of {placed[0]}"] = transplanted(agents[seed], agents[placed[0]], head)
            changed[placed[0], f"{head} of {seed}"] = transplanted(agents[placed[0]], agents[seed], head)
    stages = {name: episode.stage for name, episode in play(changed, env).items()}

    table = ["| seed | stage | hand at the end, mm | with a change |", "|---|---|---|---|"]
    for seed, episode in plain.items():
        hand = ", ".join(f"{1000 * value:.0f}" for value in episode.hand)
        own = ", ".join(f"{what}: {stage}" for (who, what), stage in stages.items() if who == seed)
        table.append(f"| {seed} | {episode.stage} | {hand} | {own} |")
    if placed:
        spread = disagreement([agent.policy for agent in agents.values()], plain[placed[0]].frames)
        table += ["", f"Seeds disagree by {1000 * spread:.1f} mm (root mean square, frames of seed {placed[0]})."]
    Path(out).mkdir(parents=True, exist_ok=True)
    (Path(out) / "table.md").write_text("\n".join(table) + "\n")
    print("\n".join(table))
    if placed and failed:
        both = side_by_side([plain[seed].frames for seed in (failed[0], placed[0])])
        write_video(Path(out) / "failing_and_succeeding.mp4", both, FPS)


def play(agents: Mapping[Any, PolicyAgent], env: dict[str, Any]) -> dict[Any, Watched]:
    """One episode of each agent."""
    names, watched = list(agents), [Watched() for _ in agents]

    def watch(number, episode, action, step):
        watched[number].hand = step.sim["tcp_pose"][:3]
        watched[number].frames.append(step.seen["pixels"]["base"])

    starts = [[1000]] * len(names)
    for number, rollout in roll_out(list(agents.values()), env, starts, on_step=watch, filmed=range(len(names))):
        if rollout.error:
            raise rollout.error
        watched[number].stage = rollout.episodes[0].stage
    return dict(zip(names, watched, strict=True))


def thresholded(agent: PolicyAgent, value: float) -> PolicyAgent:
    """The same heads with another threshold of the gripper's logit."""
    config = copy(agent.policy.config)
    config.gripper_threshold = value
    return _with(agent, config=config)


def transplanted(agent: PolicyAgent, donor: PolicyAgent, head: str) -> PolicyAgent:
    """The same policy with one head of another."""
    heads = copy(agent.policy.heads)
    heads._modules = dict(heads._modules) | {head: getattr(donor.policy.heads, head)}
    return _with(agent, heads=heads)


def _with(agent: PolicyAgent, **parts: Any) -> PolicyAgent:
    policy = copy(agent.policy)
    policy._modules = dict(policy._modules)
    for name, value in parts.items():
        setattr(policy, name, value)
    policy.reset()
    return PolicyAgent(policy, agent.preprocessor, agent.postprocessor)


@torch.inference_mode()
def disagreement(policies: list[FrozenViTChunkPolicy], frames: list[np.ndarray]) -> float:
    """How far the seeds' next translations lie from their mean, on the same frames, in metres."""
    images = torch.from_numpy(np.stack(frames)).permute(0, 3, 1, 2) / 255
    pooled = policies[0].pool(images)
    moves = torch.stack([policy.heads(pooled)[0][:, 0, :3] for policy in policies])
    return (moves - moves.mean(dim=0)).pow(2).mean().sqrt().item()


if __name__ == "__main__":
    main(*sys.argv[1:])
