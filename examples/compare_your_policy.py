"""Your own LeRobot checkpoints beside the rows of a study: one checkpoint per training seed.

Usage: python examples/compare_your_policy.py results/readouts reference <checkpoint> [<checkpoint> ...]
"""

import sys
from pathlib import Path

import draccus
import yaml

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill.study.agents import PolicyAgent
from lerobot_constructskill.study.plan import StudyPlan
from lerobot_constructskill.study.rollout import roll_out
from lerobot_constructskill.study.rows import read_rows
from lerobot_constructskill.study.stats.comparisons import compare
from lerobot_constructskill.study.stats.outcomes import Counts


def main(study: Path, variant: str, checkpoints: list[str]) -> None:
    plan = draccus.decode(StudyPlan, yaml.safe_load((study / "plan.yaml").read_text()))
    setting, env = next((name, setting.env) for name, setting in plan.settings.items())
    rows = read_rows(study / "rows.parquet").query("variant == @variant and setting == @setting")
    if rows.empty:
        sys.exit(f"{study} has no variant '{variant}'; it has: {', '.join(plan.variants)}.")
    theirs = rows.groupby("training_seed")["placed"].any()
    agents = [PolicyAgent.from_pretrained(Path(checkpoint)) for checkpoint in checkpoints]
    outcomes = [outcome for _, outcome in roll_out(agents, env, range(plan.eval_seed, plan.eval_seed + plan.episodes))]
    if failed := [outcome.error for outcome in outcomes if outcome.error]:
        sys.exit(f"{len(failed)} of {len(agents)} checkpoints failed, the first with: {failed[0]!r}")
    placed = sum(any(episode.placed for episode in outcome.episodes) for outcome in outcomes)
    counts = {"yours": Counts(placed, len(agents)), variant: Counts(int(theirs.sum()), len(theirs))}
    for name, value in compare(counts, [("yours", variant)])[0]._asdict().items():
        print(f"{name:20} {value}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])
