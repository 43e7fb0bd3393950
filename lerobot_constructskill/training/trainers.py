"""What trains a policy type in a study: the class that its configuration names, or `lerobot-train`."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import draccus
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.artifacts.digests import distributions_of, file_sha256
from lerobot_constructskill.artifacts.pools import be_killed_with_parent, cores
from lerobot_constructskill.artifacts.store import Store
from lerobot_constructskill.errors import MachineError
from lerobot_constructskill.lerobot_internals import LAST_CHECKPOINT

KILLED = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
"""What ends a process from outside: somebody, or the kernel for want of memory. No policy ends itself like this."""

NO_MEMORY = ("can't allocate memory", "out of memory", "OutOfDeviceMemory", "OutOfHostMemory")
"""What torch, on a CPU and on a GPU, and Vulkan say in a `RuntimeError` for want of it."""

OF_THE_MACHINE = (
    *(*NO_MEMORY, "No space left on device", "Disk quota exceeded", "CUDA error", "NVIDIA driver"),
    *("ConnectError", "ConnectionError", "ConnectTimeout", "ReadTimeout", "Connection reset"),
)
"""What an error says that is no fault of the policy: disks, network and GPU may do the next time what they did not."""

LOADERS = 4
"""LeRobot's own number of loading processes. Each imports all of LeRobot: no more than there are cores to spare."""

ELSEWHERE = ("device", "push_to_hub", "repo_id", "private", "tags", "license")
"""Fields of every policy that say where it computes or is published, and not what it becomes."""

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
    """Distributions beside LeRobot, torch and the configuration's own whose versions may show in them."""
    heldout_mse: Callable[..., list[float | None]] | None = None
    """`(config, checkpoints, demonstrations, held_out, store)`: the error of each checkpoint's translations on
    episodes of other demonstrations, in m2; None where they lack one of its inputs. `config` says where things lie and
    compute now. Without it, none is validated on others."""

    def seeds_together(self, config: PreTrainedConfig) -> bool:
        """Whether `fit` should get many seeds at once. Where it raises, those failed that it has not written."""
        return False

    def settle(self, config: PreTrainedConfig) -> PreTrainedConfig:
        """Return the configuration with everything written out that it leaves to the machine."""
        return config

    def idle(self, config: PreTrainedConfig) -> tuple[str, ...]:
        """Fields that a policy of this configuration has no use for, so that they do not show in its checkpoint."""
        return ()

    def settled_elsewhere(self, config: PreTrainedConfig) -> list[dict[str, Any]]:
        """The fields that machines of another kind would write out otherwise: one dictionary for each kind."""
        return []

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
        writers: Mapping[int, Writer],
        epochs: int,
        batch_size: int,
        held_out: Sequence[int],
        store: Store,
    ) -> None:
        """Train each seed of `writers` on the episodes that are not held out, and write its checkpoint.

        A checkpoint is what `lerobot-eval --policy.path` loads.
        """
        raise NotImplementedError


def trainer_of(config: PreTrainedConfig) -> Trainer:
    """What trains policies of this configuration."""
    named = getattr(type(config), "study_trainer", None)
    if named is None:
        return LeRobotTrainer()
    module, name = named.split(":")
    return getattr(import_module(module), name)()


def packages_of(config: PreTrainedConfig) -> tuple[str, ...]:
    """Distributions whose versions may show in what such a policy learns and does."""
    return (*trainer_of(config).packages, *distributions_of(type(config)))


def policy_spec(config: PreTrainedConfig) -> dict[str, Any]:
    """Every field of a settled configuration that shows in its checkpoint.

    A folder that training starts from is told by its weights, wherever it lies. A name on the Hub stands for whatever
    it holds, unless `pretrained_revision` says which commit.
    """
    fields = draccus.encode(config)
    trainer = trainer_of(config)
    for name in (*ELSEWHERE, *trainer.places, *trainer.idle(config)):
        fields.pop(name, None)
    if config.pretrained_path and (weights := Path(config.pretrained_path) / "model.safetensors").is_file():
        fields["pretrained_path"] = f"sha256 {file_sha256(weights)}"
    return {"type": config.type, **fields}


class LeRobotTrainer(Trainer):
    """`lerobot-train`, for as many passes over the same demonstrations as the study says."""

    packages = ("torchvision", "torchcodec", "transformers", "diffusers")

    def fit(
        self,
        config: PreTrainedConfig,
        demonstrations: LeRobotDataset,
        writers: Mapping[int, Writer],
        epochs: int,
        batch_size: int,
        held_out: Sequence[int],
        store: Store,
    ) -> None:
        kept = sorted({*range(demonstrations.num_episodes)} - {*held_out})
        frames = sum(demonstrations.meta.episodes["length"][i] for i in kept)
        steps = epochs * -(-frames // batch_size)
        command = [
            str(Path(sys.executable).parent / "lerobot-train"),
            f"--dataset.repo_id={demonstrations.repo_id}",
            f"--dataset.root={demonstrations.root}",
            f"--dataset.episodes={kept}",
            *_flags(config),
            "--policy.push_to_hub=false",
            f"--batch_size={batch_size}",
            f"--steps={steps}",
            f"--save_freq={steps}",
            "--env_eval_freq=0",
            f"--num_workers={min(cores() - 1, LOADERS)}",
        ]
        for seed, write in writers.items():
            with write() as folder:
                output = folder.with_name(f"lerobot-train-{os.getpid()}")
                said = _call([*command, f"--seed={seed}", f"--output_dir={output}"])
                (output / LAST_CHECKPOINT).resolve().rename(folder)
                (folder / "lerobot-train.log").write_text(said)


def _flags(config: PreTrainedConfig) -> list[str]:
    """The fields that are not their type's defaults, as LeRobot's flags."""
    default = draccus.encode(PreTrainedConfig.get_choice_class(config.type)(device=config.device))
    given = {name: value for name, value in draccus.encode(config).items() if value != default[name]}
    flags = {"type": config.type, "device": config.device, **given}
    return [f"--policy.{name}={v if isinstance(v, str) else json.dumps(v)}" for name, v in flags.items()]


def _call(command: list[str]) -> str:
    """Run a command and return what it said.

    Raises:
        RuntimeError: it failed; all that it said is the exception's note.
        MachineError: it, or a process of its own, was killed or ran out of memory.
    """
    done = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        preexec_fn=be_killed_with_parent,
    )
    if -done.returncode in KILLED:
        name = signal.Signals(-done.returncode).name
        raise MachineError(f"lerobot-train was killed ({name}), for want of memory perhaps; the same command goes on.")
    if done.returncode and any(words in done.stdout for words in (*NO_MEMORY, "killed by signal")):
        raise MachineError(
            "lerobot-train, or a process of its own, ran out of memory: where nothing else takes it, "
            "training.batch_size is too large for this machine."
        )
    if done.returncode:
        lines = done.stdout.strip().splitlines() or ["nothing"]
        if any(words in lines[-1] for words in OF_THE_MACHINE):
            raise MachineError(f"lerobot-train could not go on: {lines[-1]}")
        error = RuntimeError(f"lerobot-train ended with status {done.returncode} and said last: {lines[-1]}")
        error.add_note(done.stdout)
        raise error
    return done.stdout
