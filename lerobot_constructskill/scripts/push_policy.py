"""`constructskill-push-policy`: upload a checkpoint to the Hub, with its outcomes on its card."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_constructskill.bounds import Checked, RepoId
from lerobot_constructskill.contract import get_task
from lerobot_constructskill.errors import MissingError
from lerobot_constructskill.lerobot_internals import TRAIN_CONFIG, TRAINED
from lerobot_constructskill.scripts.console import run

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


def push_policy(config: PushPolicyConfig) -> str:
    """Push and return the name.

    Raises:
        FileNotFoundError: there is no checkpoint, or no evaluation.
        ValueError: there is no such task.
        OSError: the Hub refused, or the connection broke.
    """
    from huggingface_hub import HfApi

    from lerobot_constructskill.dataset.dataset import read_facts
    from lerobot_constructskill.dataset.hub import check_private, one_sentence
    from lerobot_constructskill.dataset.policy_card import render_card, seed_outcomes

    for name in (TRAIN_CONFIG, "config.json"):
        if not (config.policy_path / name).is_file():
            raise MissingError(f"{config.policy_path / name} is missing: name a checkpoint's pretrained_model folder.")
    train, policy = TRAINED.read(config.policy_path / TRAIN_CONFIG), read_facts(config.policy_path, "config.json")
    outcomes, task = seed_outcomes(config.evaluations), get_task(config.task).name
    card, api = render_card(config.repo_id, outcomes, task, train, policy), HfApi()
    with one_sentence(config.repo_id):
        api.create_repo(config.repo_id, private=config.private, exist_ok=True)
        if config.private:
            check_private(config.repo_id)
        api.upload_folder(repo_id=config.repo_id, folder_path=config.policy_path, allow_patterns=PUSHED)
        api.upload_file(repo_id=config.repo_id, path_or_fileobj=card.encode(), path_in_repo="README.md")
    return f"Pushed: {config.repo_id}"


def main() -> None:
    run(PushPolicyConfig, push_policy)
