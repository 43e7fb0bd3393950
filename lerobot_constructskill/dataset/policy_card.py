"""What a policy's card says beyond LeRobot's: outcomes per training seed, the data set's revision, the backbone."""

from pathlib import Path
from typing import Any

from lerobot_constructskill.contract import REWARD_LIFTED, REWARD_PLACED
from lerobot_constructskill.dataset import markdown
from lerobot_constructskill.dataset.dataset import read_facts
from lerobot_constructskill.errors import InputError, MissingError
from lerobot_constructskill.lerobot_internals import largest_rewards


def seed_outcomes(folder: Path) -> list[tuple[int, int, int, int]]:
    """Seed, lifted, placed and evaluated episodes of each `seed_*/eval_info.json` that lerobot-eval wrote.

    Raises:
        FileNotFoundError: there is none.
    """
    outcomes = []
    for path in folder.glob("seed_*/eval_info.json"):
        info = read_facts(folder, str(path.relative_to(folder)))
        try:
            stages = largest_rewards(info)
            seed = int(path.parent.name.removeprefix("seed_"))
        except (TypeError, ValueError) as error:
            raise InputError(f"{path} is not what lerobot-eval writes ({error}).") from None
        lifted, placed = (sum(stage >= reward for stage in stages) for reward in (REWARD_LIFTED, REWARD_PLACED))
        outcomes.append((seed, lifted, placed, len(stages)))
    if not outcomes:
        raise MissingError(f"{folder} has no seed_*/eval_info.json of lerobot-eval.")
    return sorted(outcomes)


def render_outcomes(
    outcomes: list[tuple[int, int, int, int]], task: str, train: dict[str, Any], policy: dict[str, Any]
) -> str:
    """The section, in Markdown, from `train_config.json` and the policy's `config.json`."""
    backbone = {name: policy.get(f"backbone_{name}") for name in ("source", "sha256", "precision")}
    return markdown.render(
        "policy_card.md.j2",
        outcomes=outcomes,
        task=task,
        this_seed=train["seed"],
        dataset=train["dataset"]["repo_id"],
        revision=train["dataset"]["revision"],
        backbone=backbone | {"name": policy["backbone"]} if "backbone" in policy else None,
    )
