"""Your own LeRobot checkpoints beside a variant of a published study: one checkpoint per training seed.

Usage: python examples/compare_your_policy.py results/precise brick_on_brick/precise <checkpoint> [<checkpoint> ...]

They are evaluated where the variant was: in its setting, from its starts. Do as many seeds place at least once (exact
tests of counts), and do seeds place as often (a permutation of seeds)?
"""

import sys
from pathlib import Path

import numpy as np
import yaml

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill.analysis.stats.comparisons import compare
from lerobot_constructskill.analysis.stats.outcomes import Counts, count, seed_outcomes
from lerobot_constructskill.analysis.stats.spread import mean_p_value
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.rollout.lockstep import roll_out
from lerobot_constructskill.study.rows import read_rows


def main(root: Path, arm: str, checkpoints: list[str]) -> None:
    study = yaml.safe_load((root / "study.yaml").read_text())
    rows = read_rows(root / "rows.parquet")
    rows = rows[rows["setting"] + "/" + rows["variant"] == arm]
    if rows.empty:
        arms = [f"{setting}/{variant}" for setting in study["settings"] for variant in study["variants"]]
        sys.exit(f"{root} has no '{arm}'; it has: {', '.join(arms)}.")
    theirs = seed_outcomes(rows)
    agents = [PolicyAgent.from_pretrained(Path(checkpoint)) for checkpoint in checkpoints]
    seeds = range(study["eval_seed"], study["eval_seed"] + study["episodes"])
    env = study["settings"][arm.partition("/")[0]]["env"]
    by_number = dict(roll_out(agents, env, seeds))  # each as it ends
    outcomes = [by_number[number] for number in range(len(agents))]
    if failed := [outcome.error for outcome in outcomes if outcome.error]:
        sys.exit(f"{len(failed)} of {len(agents)} checkpoints failed, the first with: {failed[0]!r}")
    placed = [sum(episode.placed for episode in outcome.episodes) for outcome in outcomes]
    print(f"{'yours':20} each seed placed {placed} of {len(seeds)}")
    print(f"{arm:20} each seed placed {theirs['placed'].tolist()} of {len(seeds)}")
    counts = {"yours": Counts(sum(map(bool, placed)), len(agents)), arm: count(theirs, "placed")}
    for name, value in compare(counts, [("yours", arm)])[0]._asdict().items():
        print(f"{name:20} {value}")
    rates = np.array(placed) / len(seeds), theirs["placed_rate"].to_numpy()
    print(f"{'mean, permutation':20} p = {mean_p_value(*rates):.4f}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])
