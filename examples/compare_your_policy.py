"""Your own LeRobot checkpoints beside the rows of a study: one checkpoint per training seed.

Usage: python examples/compare_your_policy.py results/readouts reference <checkpoint> [<checkpoint> ...]
"""

import sys
from pathlib import Path

import yaml

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill.analysis.stats.comparisons import compare
from lerobot_constructskill.analysis.stats.outcomes import Counts, count, seed_outcomes
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.rollout.lockstep import roll_out
from lerobot_constructskill.study.rows import read_rows


def main(root: Path, variant: str, checkpoints: list[str]) -> None:
    study = yaml.safe_load((root / "study.yaml").read_text())
    setting, env = next((name, setting["env"]) for name, setting in study["settings"].items())
    rows = read_rows(root / "rows.parquet").query("variant == @variant and setting == @setting")
    if rows.empty:
        sys.exit(f"{root} has no variant '{variant}'; it has: {', '.join(study['variants'])}.")
    agents = [PolicyAgent.from_pretrained(Path(checkpoint)) for checkpoint in checkpoints]
    seeds = range(study["eval_seed"], study["eval_seed"] + study["episodes"])
    outcomes = [outcome for _, outcome in roll_out(agents, env, seeds)]
    if failed := [outcome.error for outcome in outcomes if outcome.error]:
        sys.exit(f"{len(failed)} of {len(agents)} checkpoints failed, the first with: {failed[0]!r}")
    placed = sum(any(episode.placed for episode in outcome.episodes) for outcome in outcomes)
    counts = {"yours": Counts(placed, len(agents)), variant: count(seed_outcomes(rows), "placed")}
    for name, value in compare(counts, [("yours", variant)])[0]._asdict().items():
        print(f"{name:20} {value}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])
