"""A policy's card on the Hub: outcomes per training seed, the data set's revision, and the backbone."""

from pathlib import Path
from typing import Any

from lerobot_constructskill.contract import REWARD_LIFTED, REWARD_PLACED
from lerobot_constructskill.dataset import markdown
from lerobot_constructskill.errors import InputError, MissingError
from lerobot_constructskill.lerobot_internals import EVALUATED


def seed_outcomes(folder: Path) -> list[tuple[int, int, int, int]]:
    """Seed, lifted, placed and evaluated episodes of each `seed_*/eval_info.json` that lerobot-eval wrote.

    Raises:
        FileNotFoundError: there is none.
    """
    outcomes = []
    for path in folder.glob("seed_*/eval_info.json"):
        name = path.parent.name.removeprefix("seed_")
        if not (name.isascii() and name.isdecimal()):
            raise InputError(f"'{path.parent}' is of no training seed: name it seed_0, seed_1, ..., or move it away.")
        stages = [reward for task in EVALUATED.read(path)["per_task"] for reward in task["metrics"]["max_rewards"]]
        lifted, placed = (sum(stage >= reward for stage in stages) for reward in (REWARD_LIFTED, REWARD_PLACED))
        outcomes.append((int(name), lifted, placed, len(stages)))
    if not outcomes:
        raise MissingError(f"{folder} has no seed_*/eval_info.json of lerobot-eval.")
    seeds = [seed for seed, *_ in outcomes]
    if twice := [seed for seed in seeds if seeds.count(seed) > 1]:
        raise InputError(f"'{folder}' has two folders of training seed {twice[0]}.")
    return sorted(outcomes)


def render_card(
    repo_id: str, outcomes: list[tuple[int, int, int, int]], task: str, train: dict[str, Any], policy: dict[str, Any]
) -> str:
    """The card of a policy, in Markdown, from `train_config.json` (`TRAINED`) and the policy's `config.json`."""
    return markdown.render(
        "policy_card.md.j2",
        repo_id=repo_id,
        outcomes=outcomes,
        task=task,
        this_seed=train.get("seed"),
        dataset=train.get("dataset", {}).get("repo_id"),
        revision=train.get("dataset", {}).get("revision"),
        policy=policy,
    )
