"""`constructskill-fit-noise`: one iteration of DART (Laskey et al. 2017).

Train on the demonstrations, fit the noise's covariance to the policy's error on held-out demonstrations, generate with
that covariance. The expert's states under the noise are then those that the policy's own errors lead to.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from lerobot_constructskill.artifacts.folders import write_text
from lerobot_constructskill.bounds import Checked, Device, Episodes, Range, RepoId, Text
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.scripts.console import run

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

Alpha = Annotated[float, Range(above=0, most=1, unit="m2")]


@dataclass
class FitNoiseConfig(Checked):
    """Write the configuration of the next data set: that of the given set, with noise that is fitted to a policy."""

    policy_path: Text  # a checkpoint's `pretrained_model` folder, or a name on the Hub
    repo_id: RepoId  # the demonstrations, with their images and phases
    out: Path  # YAML to write, for constructskill-generate
    root: Path | None = None  # the demonstrations' folder; default: LeRobot's cache
    revision: Text | None = None  # tag, branch or commit on the Hub
    episodes: Episodes | None = None  # held-out episodes; default: every eighth, refused if trained on
    alpha: Alpha | None = None  # scale to this sum of squared errors per episode, in m2; default: as measured
    device: Device | None = None  # default: a GPU if there is one
    backbone_precision: Text | None = None  # of frozen_vit, if this machine would emulate the checkpoint's


def fit_noise(config: FitNoiseConfig) -> str:
    """Fit, write `config.out` and return a line that says what came out.

    Raises:
        FileNotFoundError: the data set or the policy is not there.
        ValueError: no such episodes, none in which the expert drives, nothing to fit on, or a policy with other
            actions or observations.
    """
    import yaml
    from lerobot.utils import auto_select_torch_device

    from lerobot_constructskill.dataset.dataset import read_provenance
    from lerobot_constructskill.dataset.hub import choose_held_out, one_sentence, open_lerobot
    from lerobot_constructskill.demos.settings import GenerateConfig, generator_facts
    from lerobot_constructskill.parsing import decode
    from lerobot_constructskill.progress import Progress
    from lerobot_constructskill.rollout.agents import PolicyAgent
    from lerobot_constructskill.rollout.offline import check_actions, observing_frames, policy_errors

    dataset = open_lerobot(config.repo_id, config.root, config.revision)
    generator = generator_facts(decode(GenerateConfig, read_provenance(dataset.root)["generator"]))
    episodes = _by_the_expert(dataset, choose_held_out(dataset, config.episodes, [config.policy_path]))
    with one_sentence(config.policy_path):
        device = config.device or str(auto_select_torch_device())
        agent = PolicyAgent.from_pretrained(config.policy_path, device, backbone_precision=config.backbone_precision)
    check_actions(agent.policy, dataset)
    bar = Progress(episodes, "demonstrations", unit="demo")
    with observing_frames(dataset):
        noisy, labels = generator["noise"]["phases"], generator["labels"]
        errors = [policy_errors(agent, dataset, episode, noisy, labels) for episode in bar]
    covariance = fit_covariance(errors, config.alpha)
    fitted_on = {
        "policy": config.policy_path,
        "dataset": config.repo_id,
        "episodes": ",".join(map(str, episodes)),
        "frames": str(sum(map(len, errors))),
        "alpha": str(config.alpha),
        "iteration": str(int((generator["noise"].get("fitted_on") or {}).get("iteration", 0)) + 1),
    }
    del generator["repo_id"]
    generator["noise"] |= {"model": "dart", "covariance": covariance.tolist(), "fitted_on": fitted_on}
    text = yaml.safe_dump(generator, sort_keys=False)
    write_text(config.out, f"# DART iteration {fitted_on['iteration']}.\n{text}")
    deviations = ", ".join(f"{1000 * value:.2f}" for value in np.sqrt(np.diag(covariance)))
    return f"Noise of {deviations} mm (x, y, z) from {plural(int(fitted_on['frames']), 'frame')}: {config.out}"


def fit_covariance(errors: list[np.ndarray], alpha: float | None = None) -> np.ndarray:
    """Mean over episodes of the mean of e e^T, which is large where the policy is biased too.

    Args:
        errors: one (n, 3) array per episode, in metres.
        alpha: scale the covariance so that the squared error of an episode of mean length sums to this, in m2.

    Returns:
        (3, 3) in m2

    Raises:
        ValueError: no episode has an error, or alpha is not above 0, or nothing to scale to it.
    """
    errors = [error for error in errors if len(error)]
    if not errors:
        raise InputError("The held-out episodes have no frame in a perturbed phase to fit noise on.")
    if alpha is not None and not alpha > 0:
        raise InputError(f"alpha must be above 0 m2, not {alpha}.")
    covariance = np.mean([error.T @ error / len(error) for error in errors], axis=0)
    if alpha is None:
        return covariance
    if not np.trace(covariance) > 0:
        raise InputError("The policy has no error on the held-out episodes, so there is nothing to scale to alpha.")
    length = np.mean([len(error) for error in errors])
    return covariance * alpha / (length * np.trace(covariance))


def _by_the_expert(dataset: "LeRobotDataset", episodes: list[int]) -> list[int]:
    """Those in which the expert drives: in DAgger's rounds the states are the learner's."""
    if "dagger.round" not in dataset.meta.features:
        return episodes
    first = {episode: dataset.meta.episodes[episode]["dataset_from_index"] for episode in episodes}
    by_expert = [episode for episode in episodes if not dataset.hf_dataset[first[episode]]["dagger.round"]]
    if not by_expert:
        raise InputError(f"In episodes {episodes} a learner drives: noise is fitted to errors in the expert's states.")
    return by_expert


def main() -> None:
    run(FitNoiseConfig, fit_noise)
