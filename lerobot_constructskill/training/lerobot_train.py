"""Trains any LeRobot policy by LeRobot's own command, `lerobot-train`, in a process of its own."""

import json
import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import draccus
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.artifacts.failures import NO_MEMORY
from lerobot_constructskill.artifacts.pools import be_killed_with_parent, cores
from lerobot_constructskill.errors import MachineError
from lerobot_constructskill.lerobot_internals import LAST_CHECKPOINT
from lerobot_constructskill.training.recipe import Training
from lerobot_constructskill.training.trainers import Trainer

KILLED = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
"""Signals that a user sends, or the kernel when memory runs out."""

LOADERS = 4
"""LeRobot's own number of loading processes. Each imports all of LeRobot: no more than there are cores to spare."""

LOG = "lerobot-train.log"
"""In a checkpoint's folder, and beside it while it is made: all that was printed."""

BAR = re.compile(r"\d+%\|")
"""In every line of a progress bar."""


class LeRobotTrainer(Trainer):
    """`lerobot-train`, for as many epochs of the same demonstrations as the study says."""

    packages = ("torchvision", "torchcodec", "transformers", "diffusers")

    def fit(
        self,
        config: PreTrainedConfig,
        dataset: LeRobotDataset,
        seeds: Sequence[int],
        training: Training,
        held_out: Sequence[int],
        folder: Path,
    ) -> dict[str, str]:
        """Train one seed after another, as `Trainer.fit` says."""
        kept = sorted({*range(dataset.num_episodes)} - {*held_out})
        frames = sum(dataset.meta.episodes["length"][i] for i in kept)
        steps = training.epochs * -(-frames // training.batch_size)
        command = [
            str(Path(sys.executable).parent / "lerobot-train"),
            f"--dataset.repo_id={dataset.repo_id}",
            f"--dataset.root={dataset.root}",
            f"--dataset.episodes={kept}",
            *_flags(config),
            "--policy.push_to_hub=false",
            f"--batch_size={training.batch_size}",
            f"--steps={steps}",
            f"--save_freq={steps}",
            "--env_eval_freq=0",
            f"--num_workers={min(cores() - 1, LOADERS)}",
        ]
        for seed in seeds:
            output, log = folder.with_name(f"lerobot-train-{seed}"), folder.with_name(LOG)
            _call([*command, f"--seed={seed}", f"--output_dir={output}"], log)
            (output / LAST_CHECKPOINT).resolve().rename(folder / f"seed_{seed}")
            log.rename(folder / f"seed_{seed}" / LOG)
        return {}


def _flags(config: PreTrainedConfig) -> list[str]:
    """The fields that are not their type's defaults, as LeRobot's flags."""
    default = draccus.encode(PreTrainedConfig.get_choice_class(config.type)(device=config.device))
    given = {name: value for name, value in draccus.encode(config).items() if value != default[name]}
    flags = {"type": config.type, "device": config.device, **given}
    return [f"--policy.{name}={v if isinstance(v, str) else json.dumps(v)}" for name, v in flags.items()]


def _call(command: list[str], log: Path) -> None:
    """Run a command; all that it prints is in the log as soon as it is printed.

    Raises:
        RuntimeError: it failed.
        MachineError: it, or a process of its own, was killed or ran out of memory.
        Each has as its note all that was printed.
    """
    with log.open("w", encoding="utf-8") as file:
        done = subprocess.run(command, stdout=file, stderr=subprocess.STDOUT, preexec_fn=be_killed_with_parent)
    if done.returncode:
        said = log.read_text(encoding="utf-8", errors="replace")
        error = _judge(done.returncode, said)
        error.add_note(said)
        raise error


def _judge(status: int, said: str) -> Exception:
    """What to raise of a command that failed."""
    if -status in KILLED:
        name = signal.Signals(-status).name
        return MachineError(
            f"lerobot-train was killed ({name}), perhaps out of memory; run the same command to continue."
        )
    if any(words in said for words in (*NO_MEMORY, "killed by signal")):
        return MachineError(
            "lerobot-train, or a process of its own, ran out of memory: where nothing else takes it, "
            "training.batch_size is too large for this machine."
        )
    return RuntimeError(f"lerobot-train ended with status {status}: {_reason(said)}")


def _reason(said: str) -> str:
    """The last exception's own line; where none was printed, the last line that is no progress bar's."""
    _, printed, traceback = said.rpartition("Traceback (most recent call last):")
    lines = (traceback if printed else said).splitlines()
    if printed:  # its frames are indented, and what follows it is a bar that was closed
        lines = [line for line in lines if line and not line[0].isspace()][:1]
    lines = [line.strip() for line in lines if line.strip() and not BAR.search(line)]
    return lines[-1] if lines else "it printed nothing"
