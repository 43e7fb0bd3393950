"""What trains a policy type in a study: the class that its configuration names, or `lerobot-train`."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import draccus
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import file_sha256, versions
from lerobot_constructskill.artifacts.store import Store

NO_MEMORY = ("can't allocate memory", "out of memory", "OutOfDeviceMemory", "OutOfHostMemory")
"""What torch, on a CPU and on a GPU, and Vulkan say in a `RuntimeError` for want of it."""

OF_THE_MACHINE = (
    *(*NO_MEMORY, "No space left on device", "Disk quota exceeded", "CUDA error", "NVIDIA driver"),
    *("ConnectError", "ConnectionError", "ConnectTimeout", "ReadTimeout", "Connection reset"),
)
"""What an error says that is no fault of the policy: disks, network and GPU may do the next time what they did not."""

BY_LEROBOT = "lerobot_constructskill.training.lerobot_train:LeRobotTrainer"
"""What trains policies whose configuration names nothing else."""

ELSEWHERE = ("push_to_hub", "repo_id", "private", "tags", "license")
"""Fields of every policy that say where it is published, and not what it becomes."""

type Writer = Callable[..., AbstractContextManager[Path]]
"""Gives the path of a folder that is not there yet; the checkpoint appears when the block ends. It takes what rows are
to say of the checkpoint: `heldout_mse_m2`, its error on what is held out, and `made_of`, name to what it stands on."""


def flush_denormals() -> None:
    """Have this process take for zero what is too small for a float32's whole precision, in each of torch's threads.

    Sharp keypoints underflow, and a core that computes with such numbers trains them several times slower. Call this
    before torch first works in parallel, be it to hash weights: a thread takes the setting over when it is made.
    """
    torch.set_flush_denormal(True)


class Trainer:
    """Trains a policy type. A configuration class names its own as `study_trainer = "module:class"`."""

    places: tuple[str, ...] = ()
    """Fields of the configuration that say where something lies and do not show in a checkpoint's weights."""
    packages: tuple[str, ...] = ()
    """Distributions beside LeRobot, torch and those of the policy and the trainer whose versions may show in them."""
    heldout_mse: Callable[..., list[float | None]] | None = None
    """`(config, checkpoints, demonstrations, held_out, store)`: the error of each checkpoint's translations on
    episodes of other demonstrations, in m2; None where they lack one of its inputs. `config` says where things lie and
    compute now. A trainer that has it tells its writers the error on its own demonstrations. For all others a study
    measures both with the checkpoint, as any policy's (`rollout/heldout.py`)."""

    def seeds_together(self, config: PreTrainedConfig) -> bool:
        """Whether `fit` should get many seeds at once. Where it raises, those failed that it has not written."""
        return False

    def stack(self, config: PreTrainedConfig) -> int:
        """How many seeds are one computation, whose bits may depend on all of them: 0 to 9, 10 to 19 and so on for 10.

        `fit` then gets all seeds of such a stack, also those that nobody asked for: what is missing of a study shows
        in nothing that is made.
        """
        return 1

    def settle(self, config: PreTrainedConfig) -> PreTrainedConfig:
        """Return the configuration with everything written out that it leaves to the machine."""
        return config

    def idle(self, config: PreTrainedConfig) -> tuple[str, ...]:
        """Fields that a policy of this configuration has no use for, so that they do not show in its checkpoint."""
        return ()

    def settled_elsewhere(self, config: PreTrainedConfig) -> list[dict[str, Any]]:
        """The fields that machines of another kind would write out otherwise: one dictionary for each kind.

        Of a GPU that this machine does not have nothing can be known: LeRobot takes the CPU in its place.
        """
        return [] if config.device == "cpu" else [{"device": "cpu"}]

    @contextmanager
    def joined(
        self, config: PreTrainedConfig, whole: LeRobotDataset, parts: Sequence[LeRobotDataset], store: Store
    ) -> Iterator[None]:
        """Have ready for the block whatever `fit` computes of every frame of `whole`, which is its parts in order.

        What was computed of a part once is not computed again.
        """
        yield

    def fit(
        self,
        config: PreTrainedConfig,
        demonstrations: LeRobotDataset,
        writers: Mapping[int, Writer | None],
        epochs: int,
        batch_size: int,
        held_out: Sequence[int],
        store: Store,
    ) -> None:
        """Train each seed of `writers` on the episodes that are not held out, and write its checkpoint.

        A checkpoint is what `lerobot-eval --policy.path` loads. A seed of a stack that has no writer is trained with
        the others and not kept.
        """
        raise NotImplementedError


def trainer_of(config: PreTrainedConfig) -> Trainer:
    """What trains policies of this configuration."""
    module, name = getattr(type(config), "study_trainer", BY_LEROBOT).split(":")
    return getattr(import_module(module), name)()


def versions_of(config: PreTrainedConfig) -> dict[str, str]:
    """What the packages are that may show in what such a policy learns and does, beside LeRobot, torch and ours.

    Others' code, of the policy and of its trainer, is told by its source too.
    """
    trainer = trainer_of(config)
    return versions(*trainer.packages) | code_of(type(config).__module__, type(trainer).__module__)


def policy_spec(config: PreTrainedConfig) -> dict[str, Any]:
    """Every field of a settled configuration that shows in its checkpoint.

    A folder that training starts from is told by its weights, wherever it lies. A name on the Hub stands for whatever
    it holds, unless `pretrained_revision` says which commit.
    """
    fields = draccus.encode(config) | {
        "device": str(config.device).partition(":")[0]
    }  # which of several does not show
    trainer = trainer_of(config)
    for name in (*ELSEWHERE, *trainer.places, *trainer.idle(config)):
        fields.pop(name, None)
    if config.pretrained_path and (weights := Path(config.pretrained_path) / "model.safetensors").is_file():
        fields["pretrained_path"] = f"sha256 {file_sha256(weights)}"
    return {"type": config.type, **fields}
