"""What a policy's card says beyond LeRobot's: outcomes per training seed, the data set's revision, the backbone."""

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

from lerobot_constructskill.contract import REWARD_LIFTED, REWARD_PLACED
from lerobot_constructskill.errors import MissingError


def seed_outcomes(folder: Path) -> list[tuple[int, int, int, int]]:
    """Seed, lifted, placed and evaluated episodes of each `seed_*/eval_info.json` that lerobot-eval wrote.

    Raises:
        FileNotFoundError: there is none.
    """
    outcomes = []
    for path in folder.glob("seed_*/eval_info.json"):
        tasks = json.loads(path.read_text())["per_task"]
        stages = [stage for task in tasks for stage in task["metrics"]["max_rewards"]]
        lifted, placed = (sum(stage >= reward for stage in stages) for reward in (REWARD_LIFTED, REWARD_PLACED))
        outcomes.append((int(path.parent.name.removeprefix("seed_")), lifted, placed, len(stages)))
    if not outcomes:
        raise MissingError(f"{folder} has no seed_*/eval_info.json of lerobot-eval.")
    return sorted(outcomes)


def render_outcomes(
    outcomes: list[tuple[int, int, int, int]], task: str, train: dict[str, Any], policy: dict[str, Any]
) -> str:
    """The section, in Markdown, from `train_config.json` and the policy's `config.json`."""
    from jinja2 import Environment, StrictUndefined

    backbone = {name: policy.get(f"backbone_{name}") for name in ("source", "sha256", "precision")}
    template = files(__package__).joinpath("policy_card.md.j2").read_text()
    environment = Environment(undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, autoescape=False)
    return environment.from_string(template).render(
        outcomes=outcomes,
        task=task,
        this_seed=train["seed"],
        dataset=train["dataset"]["repo_id"],
        revision=train["dataset"]["revision"],
        backbone=backbone | {"name": policy["backbone"]} if "backbone" in policy else None,
    )
