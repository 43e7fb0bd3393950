"""`constructskill-push-policy`: upload a checkpoint to the Hub, with its outcomes on its card."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_constructskill.bounds import Checked, RepoId, seed_of
from lerobot_constructskill.contract import REWARD_LIFTED, REWARD_PLACED, get_task
from lerobot_constructskill.dataset.card import render_template
from lerobot_constructskill.errors import MissingError
from lerobot_constructskill.files import Json
from lerobot_constructskill.lerobot_internals import EVALUATED, TRAIN_CONFIG, TRAINED
from lerobot_constructskill.scripts.console import command

OBJECT = Json("a JSON object")

PUSHED = ["*.safetensors", "*.json"]
"""Files of a checkpoint that leave the machine: weights, configurations and processors."""


@dataclass
class PushPolicyConfig(Checked):
    """Upload a checkpoint; its card has the lifts and placements of every evaluated training seed."""

    policy_path: Path  # a checkpoint's `pretrained_model` folder
    evaluations: Path  # folder of seed_*/eval_info.json, as lerobot-eval writes them
    repo_id: RepoId  # its name on the Hub, user/name
    task: str  # the task of its evaluation, as `--env.task`
    private: bool = False  # whether only its owner sees it


@command(
    "constructskill-push-policy --policy_path=outputs/train/seed_0/checkpoints/last/pretrained_model "
    "--evaluations=outputs/eval --repo_id=user/name --task=brick_to_bin_shifted"
)
def push_policy(config: PushPolicyConfig) -> str:
    """Push and return the name.

    Raises:
        FileNotFoundError: there is no checkpoint, or no evaluation.
        ValueError: there is no such task.
        OSError: the Hub refused, or the connection broke.
    """
    from huggingface_hub import CommitOperationAdd, HfApi

    from lerobot_constructskill.dataset.hub import check_private, hub_errors

    for name in (TRAIN_CONFIG, "config.json"):
        if not (config.policy_path / name).is_file():
            raise MissingError(f"{config.policy_path / name} is missing: name a checkpoint's pretrained_model folder.")
    train = TRAINED.read(config.policy_path / TRAIN_CONFIG)
    outcomes, task = seed_outcomes(config.evaluations), get_task(config.task).name
    card, api = card_of(config.policy_path, config.repo_id, outcomes, task, train), HfApi()
    with hub_errors(config.repo_id):
        api.create_repo(config.repo_id, private=config.private, exist_ok=True)
        if config.private:
            check_private(config.repo_id)
        files = [path for pattern in PUSHED for path in config.policy_path.glob(pattern)]
        added = [CommitOperationAdd(path.name, path) for path in files]
        added.append(CommitOperationAdd("README.md", card.encode()))
        api.create_commit(config.repo_id, added, commit_message="Weights, configuration and card")
    return f"Pushed: {config.repo_id}"


def seed_outcomes(folder: Path) -> list[tuple[int, int, int, int]]:
    """Seed, lifted, placed and evaluated episodes of each `seed_*/eval_info.json` that lerobot-eval wrote.

    Raises:
        FileNotFoundError: there is none.
    """
    outcomes = {}
    for path in folder.glob("seed_*/eval_info.json"):
        seed = seed_of(path.parent)
        stages = [reward for task in EVALUATED.read(path)["per_task"] for reward in task["metrics"]["max_rewards"]]
        lifted, placed = (sum(stage >= reward for stage in stages) for reward in (REWARD_LIFTED, REWARD_PLACED))
        outcomes[seed] = lifted, placed, len(stages)
    if not outcomes:
        raise MissingError(f"{folder} has no seed_*/eval_info.json of lerobot-eval.")
    return [(seed, *counts) for seed, counts in sorted(outcomes.items())]


def card_of(
    checkpoint: Path,
    repo_id: str,
    outcomes: list[tuple[int, int, int, int]],
    task: str,
    train: Mapping[str, Any],
    flags: str = "",
) -> str:
    """The card of a policy, in Markdown.

    Args:
        checkpoint: the folder of its `config.json` and, where it has one, its `encoder.json`.
        train: `train_config.json` (`TRAINED`).
        flags: what `lerobot-eval` needs beside the policy and the task; "" where they are not known.
    """
    record, data = checkpoint / "encoder.json", train.get("dataset", {})
    return render_template(
        "policy_card.md.j2",
        repo_id=repo_id,
        outcomes=outcomes,
        task=task,
        this_seed=train.get("seed"),
        dataset=data.get("repo_id"),
        revision=data.get("revision"),
        policy=OBJECT.read(checkpoint / "config.json"),
        encoder=OBJECT.read(record) if record.is_file() else {},
        flags=flags,
    )
