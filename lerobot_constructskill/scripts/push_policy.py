"""`constructskill-push-policy`: upload a trained policy to the Hub by LeRobot's own push, outcomes on its card."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_constructskill.bounds import RepoId, check
from lerobot_constructskill.contract import get_task
from lerobot_constructskill.errors import MissingError
from lerobot_constructskill.lerobot_internals import TRAIN_CONFIG, TRAINED
from lerobot_constructskill.scripts.console import run


@dataclass
class PushPolicyConfig:
    """Upload a checkpoint; its card also has the lifts and placements of every evaluated training seed."""

    policy_path: Path  # a checkpoint's `pretrained_model` folder
    evaluations: Path  # folder of seed_*/eval_info.json, as lerobot-eval writes them
    repo_id: RepoId  # its name on the Hub, user/name
    task: str  # the task of its evaluation, as `--env.task`
    private: bool = False  # whether only its owner sees it

    def __post_init__(self):
        check(self)
        get_task(self.task)


def push_policy(config: PushPolicyConfig) -> str:
    """Push and return the name.

    Raises:
        FileNotFoundError: there is no checkpoint, or no evaluation.
        OSError: the Hub refused, or the connection broke.
    """
    from lerobot_constructskill.dataset.dataset import read_facts
    from lerobot_constructskill.dataset.hub import check_private, one_sentence
    from lerobot_constructskill.dataset.policy_card import render_outcomes, seed_outcomes

    for name in (TRAIN_CONFIG, "config.json"):
        if not (config.policy_path / name).is_file():
            raise MissingError(f"{config.policy_path / name} is missing: name a checkpoint's pretrained_model folder.")
    train, policy = TRAINED.read(config.policy_path / TRAIN_CONFIG), read_facts(config.policy_path, "config.json")
    has_record = (config.policy_path / "encoder.json").is_file()
    encoder = read_facts(config.policy_path, "encoder.json") if has_record else None
    section = render_outcomes(seed_outcomes(config.evaluations), config.task, train, policy, encoder)
    with one_sentence(config.repo_id):
        if config.private:
            check_private(config.repo_id)
        _push(config, section, policy["device"])
    return f"Pushed: {config.repo_id}"


def _push(config: PushPolicyConfig, section: str, device: str | None) -> None:
    """Load it on any machine, and push it as it is: with the device that it was trained on."""
    from huggingface_hub import HfApi, ModelCard
    from lerobot.policies import get_policy_class

    from lerobot_constructskill.lerobot_internals import TrainPipelineConfig
    from lerobot_constructskill.policy_types import read_policy

    policy_config = read_policy(config.policy_path)
    policy_config.repo_id, policy_config.private, policy_config.device = config.repo_id, config.private, "cpu"
    policy = get_policy_class(policy_config.type).from_pretrained(config.policy_path, config=policy_config)
    policy.config.device = device
    policy.push_model_to_hub(TrainPipelineConfig.from_pretrained(config.policy_path))
    HfApi().upload_folder(repo_id=config.repo_id, folder_path=config.policy_path, allow_patterns="policy_*processor*")
    card = ModelCard.load(config.repo_id)
    card.text += section
    card.push_to_hub(config.repo_id)


def main() -> None:
    run(PushPolicyConfig, push_policy)


if __name__ == "__main__":
    main()
