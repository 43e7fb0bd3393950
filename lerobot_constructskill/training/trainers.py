"""Trainers of policy types, and the policy that one trains. By default `lerobot-train` trains."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import draccus
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import digest, known_sha256, versions
from lerobot_constructskill.artifacts.store import Node
from lerobot_constructskill.lerobot_internals import TRAIN_CONFIG
from lerobot_constructskill.policy_types import decode_policy
from lerobot_constructskill.training.recipe import FACTS, Training

BY_LEROBOT = "lerobot_constructskill.training.lerobot_train:LeRobotTrainer"
"""The trainer of policies whose configuration names no other."""

PUBLISHED = ("push_to_hub", "repo_id", "private", "tags", "license")
"""Fields of every policy that say where it is published. They do not show in its weights."""


def flush_denormals() -> None:
    """Treat denormal numbers as zero, in all of torch's threads.

    Sharp keypoints underflow, and computing with denormal numbers trains them several times slower. Call this before
    torch first works in parallel: a thread takes the setting over when it is made.
    """
    torch.set_flush_denormal(True)


class Trainer:
    """Trains a policy type. A configuration class names its own as `study_trainer = "module:class"`."""

    places: tuple[str, ...] = ()
    """Fields of the configuration that say where something lies and do not show in a checkpoint's weights."""
    packages: tuple[str, ...] = ()
    """Distributions beside LeRobot, torch and those of the policy and the trainer whose versions may show in them."""

    def settle(self, config: PreTrainedConfig) -> list[PreTrainedConfig]:
        """Resolve what a configuration leaves to the machine.

        Returns:
            The configuration on this machine, then those on other kinds of machine. A GPU that this machine lacks is
            not among them: LeRobot takes the CPU in its place.
        """
        return [config] if config.device == "cpu" else [config, replace(config, device="cpu")]

    def stack(self, config: PreTrainedConfig) -> int:
        """How many seeds are trained as one computation: 0 to 9, 10 to 19 and so on for 10.

        `fit` gets all seeds of a stack, because the bits of one may depend on the others.
        """
        return 1

    def is_single_threaded(self, config: PreTrainedConfig) -> bool:
        """Whether `fit` keeps one core busy, so that several stacks are trained at the same time."""
        return False

    def learns_from(self, config: PreTrainedConfig, demonstrations: Node) -> Node:
        """The data set that `fit` gets: the demonstrations, or what is computed of them once for all seeds."""
        return demonstrations

    def fit(
        self,
        config: PreTrainedConfig,
        dataset: LeRobotDataset,
        seeds: Sequence[int],
        training: Training,
        held_out: Sequence[int],
        folder: Path,
    ) -> dict[str, str]:
        """Train each seed on the episodes that are not held out, and write its checkpoint to `folder/seed_<seed>`.

        A checkpoint is what `lerobot-eval --policy.path` loads.

        Args:
            dataset: what `learns_from` returned.
            held_out: numbers of the episodes that are not trained on.

        Returns:
            Versions for the rows beside those of packages, such as the backbone's: name to version.
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class Learner:
    """A policy that is to be trained.

    Args:
        config: the configuration, in which all that the machine decides is written out.
        elsewhere: the same policy as other kinds of machine would train it.
    """

    config: PreTrainedConfig
    elsewhere: tuple["Learner", ...] = ()

    @classmethod
    def of(cls, fields: Mapping[str, Any]) -> "Learner":
        """The policy of some plain fields, `type` among them.

        Raises:
            InputError: they do not make one.
        """
        config = decode_policy(fields)
        here, *elsewhere = trainer_of(config).settle(config)
        return cls(here, tuple(map(cls, elsewhere)))

    @property
    def acting(self) -> dict[str, Any]:
        """Fields that a checkpoint of it has to be loaded with on this machine: a path may differ by now."""
        return {name: getattr(self.config, name) for name in ("device", *self.trainer.places)}

    @property
    def trainer(self) -> Trainer:
        return trainer_of(self.config)

    def facts(self) -> dict[str, Any]:
        """Every field that shows in a checkpoint; in place of the others stand their defaults.

        A folder that training starts from is told by its files, wherever it lies. A name on the Hub stands for
        whatever it holds, unless `pretrained_revision` says which commit.
        """
        fields, default = draccus.encode(self.config), draccus.encode(type(self.config)(device="cpu"))
        fields |= {name: default[name] for name in (*PUBLISHED, *self.trainer.places)}
        fields |= {"type": self.config.type, "device": str(self.config.device).partition(":")[0]}
        if (start := self.config.pretrained_path) and Path(start).is_dir():
            fields["pretrained_path"] = f"sha256 {start_sha256(Path(start))}"
        return fields

    def versions(self) -> dict[str, str]:
        """What the packages are that may show in what such a policy learns and does, beside LeRobot, torch and ours.

        Code of other packages, of the policy and of its trainer, is told by its source too.
        """
        return versions(*self.trainer.packages) | code_of(type(self.config).__module__, type(self.trainer).__module__)


def start_sha256(folder: Path) -> str:
    """Hash the weights and the processors of a checkpoint that training starts from."""
    names = sorted(path.name for path in folder.iterdir() if path.suffix in (".json", ".safetensors"))
    return digest({name: known_sha256(folder / name) for name in names if name not in (TRAIN_CONFIG, FACTS)})


def trainer_of(config: PreTrainedConfig) -> Trainer:
    """What trains policies of this configuration."""
    module, name = getattr(type(config), "study_trainer", BY_LEROBOT).split(":")
    return getattr(import_module(module), name)()
