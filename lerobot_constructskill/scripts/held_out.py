"""Commands about a policy's errors on held-out demonstrations: `constructskill-offline`, `-fit-noise`."""

import json
from dataclasses import asdict, dataclass
from glob import glob
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from lerobot_constructskill.artifacts.digests import data_sha256, file_sha256
from lerobot_constructskill.artifacts.folders import replaced, write_text
from lerobot_constructskill.bounds import BatchSize, Checked, Device, Episodes, NotEmpty, RepoId, Seed, Text
from lerobot_constructskill.dataset.dataset import read_provenance
from lerobot_constructskill.dataset.hub import choose_held_out, hub_errors, open_lerobot
from lerobot_constructskill.demos.settings import GenerateConfig, generator_facts
from lerobot_constructskill.errors import InputError, MissingError, plural
from lerobot_constructskill.lerobot_internals import TRAIN_CONFIG, TRAINED
from lerobot_constructskill.parsing import decode
from lerobot_constructskill.progress import Progress
from lerobot_constructskill.scripts.console import command
from lerobot_constructskill.training.recipe import FACTS, SAID

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset


Patterns = Annotated[list[Text], NotEmpty()]


@dataclass(kw_only=True)
class HeldOutConfig(Checked):
    """The held-out demonstrations, and how a policy is loaded that predicts their actions."""

    repo_id: RepoId  # the demonstrations
    root: Path | None = None  # their folder; default: LeRobot's cache, or the Hub
    revision: Text | None = None  # tag, branch or commit on the Hub
    episodes: Episodes | None = None  # held-out demonstrations; default: every eighth, refused if trained on
    device: Device | None = None  # default: that of the checkpoint
    backbone_precision: Text | None = None  # of frozen_vit, if this machine would emulate the checkpoint's


@dataclass(kw_only=True)
class OfflineConfig(HeldOutConfig):
    """Print and write a table of translation errors in metres, gripper accuracy and chunk consistency."""

    policies: Patterns  # `pretrained_model` folders; patterns such as outputs/fast/train/*/*/last/pretrained_model
    out: Path = Path("outputs/offline")  # folder for offline.json and offline.parquet
    batch_size: BatchSize = 32  # frames at a time
    seed: Seed = 0  # of policies that sample their actions


SHOWN = ("policy", "training_seed", "rmse_m", "mean_m", "gripper_accuracy", "gripper_change_accuracy", "consistency_m")
"""Columns that are printed; the files have all."""

TYPES = {
    "training_seed": "Int64",
    "rmse_rotation_rad": float,
    "gripper_change_accuracy": float,
    "consistency_m": float,
}
"""Types of columns in which a value can be missing."""


@command(
    "constructskill-offline --repo_id=local/fast --root=outputs/fast "
    "--policies='outputs/train/*/checkpoints/last/pretrained_model'"
)
def evaluate_offline(config: OfflineConfig) -> str:
    """Evaluate every checkpoint, write the files and return the table.

    Raises:
        MissingError: there is no such checkpoint or data set.
        InputError: there are no such episodes.
    """
    import pandas as pd

    checkpoints = _find(config.policies)
    dataset = open_lerobot(config.repo_id, config.root, config.revision)
    episodes = choose_held_out(dataset, config.episodes, checkpoints)
    source = {
        "episodes": ",".join(map(str, episodes)),
        "dataset": config.repo_id,
        "dataset_revision": dataset.revision if config.root is None else None,
        "dataset_sha256": data_sha256(dataset.root),
    }
    bar = Progress(checkpoints, "policies", unit="policy")
    rows = [_row(path, dataset, episodes, config) | source for path in bar]
    table = pd.DataFrame(rows).astype(TYPES)
    write_text(config.out / "offline.json", json.dumps(rows, indent=2) + "\n")
    with replaced(config.out / "offline.parquet") as partial:
        table.to_parquet(partial, index=False)
    shown = table[list(SHOWN)].to_string(index=False, na_rep="n/a", float_format="%.4f")
    return f"{shown}\n{plural(rows[0]['frames'], 'frame')}; every column: {config.out / 'offline.json'} and .parquet"


def _find(patterns: list[str]) -> list[Path]:
    """Checkpoints that the patterns match, in their order."""
    found = {pattern: sorted(glob(f"{pattern}/config.json")) for pattern in patterns}
    if missing := [pattern for pattern, files in found.items() if not files]:
        raise MissingError(f"'{missing[0]}' matches no checkpoint's pretrained_model folder.")
    return [Path(file).parent for files in found.values() for file in files]


def _row(checkpoint: Path, dataset: "LeRobotDataset", episodes: list[int], config: OfflineConfig) -> dict[str, Any]:
    """One checkpoint's row of the table."""
    import torch

    from lerobot_constructskill.rollout import offline
    from lerobot_constructskill.rollout.agents import PolicyAgent

    agent = PolicyAgent.from_pretrained(checkpoint, config.device, backbone_precision=config.backbone_precision)
    offline.check_actions(agent.policy, dataset)
    torch.manual_seed(config.seed)
    view = offline.open_for(dataset, agent.policy)
    bar = Progress(offline.spans(dataset, episodes), agent.policy.name, unit="demo", leave=False)
    with offline.observing_frames(dataset):
        predictions = [offline.predict(agent, view, span, config.batch_size) for span in bar]
    return {
        "policy": agent.policy.name,
        "training_seed": _training_seed(checkpoint),
        **asdict(offline.offline_metrics(predictions)),
        # Of frozen_vit's encoder, here and in training.
        "backbone_precision": getattr(agent.policy.config, "backbone_precision", None),
        "backbone_trained_precision": getattr(getattr(agent.policy, "encoder_record", None), "precision", None),
        "checkpoint": str(checkpoint),
        "weights_sha256": file_sha256(weights) if (weights := checkpoint / "model.safetensors").is_file() else None,
    }


def _training_seed(checkpoint: Path) -> int | None:
    """The seed that `lerobot-train` or a study wrote beside a checkpoint."""
    for name, kind in ((TRAIN_CONFIG, TRAINED), (FACTS, SAID)):
        if (checkpoint / name).is_file():
            return kind.read(checkpoint / name).get("seed")
    return None


@dataclass(kw_only=True)
class FitNoiseConfig(HeldOutConfig):
    """Write the configuration of the next data set: that of the given set, with noise that is fitted to a policy.

    One iteration of DART (Laskey et al. 2017): train on the demonstrations, fit the noise's covariance to the policy's
    error on held-out demonstrations, generate with that covariance. The expert's states under the noise are then those
    that the policy's own errors lead to.
    """

    policy_path: Text  # a checkpoint's `pretrained_model` folder, or a name on the Hub
    out: Path  # YAML to write, for constructskill-generate


@command(
    "constructskill-fit-noise --repo_id=local/fast --root=outputs/fast "
    "--policy_path=outputs/train/seed_0/checkpoints/last/pretrained_model --out=outputs/dart_1.yaml"
)
def fit_noise(config: FitNoiseConfig) -> str:
    """Fit, write `config.out` and return a line that says what came out.

    Raises:
        MissingError: the data set or the policy is not there.
        InputError: there are no such episodes, the expert drives in none of them, there is nothing to fit on, or the
            policy has other actions or observations.
    """
    import yaml

    from lerobot_constructskill.rollout import offline
    from lerobot_constructskill.rollout.agents import PolicyAgent

    dataset = open_lerobot(config.repo_id, config.root, config.revision)
    generator = generator_facts(decode(GenerateConfig, read_provenance(dataset.root)["generator"]))
    episodes = _by_the_expert(dataset, choose_held_out(dataset, config.episodes, [config.policy_path]))
    with hub_errors(config.policy_path):
        precision = config.backbone_precision
        agent = PolicyAgent.from_pretrained(config.policy_path, config.device, backbone_precision=precision)
    offline.check_actions(agent.policy, dataset)
    bar = Progress(episodes, "demonstrations", unit="demo")
    with offline.observing_frames(dataset):
        noisy, labels = generator["noise"]["phases"], generator["labels"]
        errors = [offline.policy_errors(agent, dataset, episode, noisy, labels) for episode in bar]
    covariance = fit_covariance(errors)
    fitted_on = {
        "policy": config.policy_path,
        "dataset": config.repo_id,
        "episodes": ",".join(map(str, episodes)),
        "frames": str(sum(map(len, errors))),
        "iteration": str(int((generator["noise"].get("fitted_on") or {}).get("iteration", 0)) + 1),
    }
    del generator["repo_id"]
    generator["noise"] |= {"model": "dart", "covariance": covariance.tolist(), "fitted_on": fitted_on}
    text = yaml.safe_dump(generator, sort_keys=False)
    write_text(config.out, f"# DART iteration {fitted_on['iteration']}.\n{text}")
    deviations = ", ".join(f"{1000 * value:.2f}" for value in np.sqrt(np.diag(covariance)))
    return f"Noise of {deviations} mm (x, y, z) from {plural(int(fitted_on['frames']), 'frame')}: {config.out}"


def fit_covariance(errors: list[np.ndarray]) -> np.ndarray:
    """Mean over episodes of the mean of e e^T, (3, 3) in m2, which is large where the policy is biased too.

    Args:
        errors: one (n, 3) array per episode, in metres.

    Raises:
        InputError: no episode has an error.
    """
    errors = [error for error in errors if len(error)]
    if not errors:
        raise InputError("The held-out episodes have no frame in a perturbed phase to fit noise on.")
    return np.mean([error.T @ error / len(error) for error in errors], axis=0)


def _by_the_expert(dataset: "LeRobotDataset", episodes: list[int]) -> list[int]:
    """The episodes in which the expert drives: in those of DAgger's rounds the states are the learner's."""
    if "dagger.round" not in dataset.meta.features:
        return episodes
    first = {episode: dataset.meta.episodes[episode]["dataset_from_index"] for episode in episodes}
    by_expert = [episode for episode in episodes if not dataset.hf_dataset[first[episode]]["dagger.round"]]
    if not by_expert:
        raise InputError(f"In episodes {episodes} a learner drives: noise is fitted to errors in the expert's states.")
    return by_expert
