"""Checkpoints as nodes of a store: a policy, trained on demonstrations with one seed or several."""

import json
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.utils import OBS_STATE

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import versions
from lerobot_constructskill.artifacts.store import Machine, Node
from lerobot_constructskill.contract import OBS_TYPES, state_names
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.training.recipe import FACTS, Training, held_out_of
from lerobot_constructskill.training.trainers import Learner, flush_denormals

LEARNING = ("lerobot", "torch", "numpy")
"""Packages whose versions may show in any checkpoint."""

ACTING = (*LEARNING, "mani_skill", "sapien")
"""Packages whose versions may show in what any agent does."""


def check_inputs(policy: PreTrainedConfig, obs_type: str, recorded: Sequence[str] | None = None) -> None:
    """Refuse a policy that reads what it would not be shown where it acts, or learns.

    Args:
        obs_type: of the environment in which it acts.
        recorded: the cameras of the demonstrations; None where it does not learn.

    Raises:
        InputError: it reads the state, and observations have pictures alone or another state, or a camera that they,
            or the demonstrations, do not have.
    """
    # LeRobot gives a policy that does not name its inputs all of the data set; its own types read the state in it.
    unsaid = getattr(policy, "use_state", type(policy).__module__.startswith("lerobot."))
    reads_state = OBS_STATE in policy.input_features if policy.input_features else unsaid
    if reads_state and obs_type == "pixels":
        raise InputError("The policy reads observation.state; where it acts, obs_type has to be 'pixels_agent_pos'.")
    lengths = {one: len(state_names(one)) for one in OBS_TYPES}
    read = (policy.input_features or {}).get(OBS_STATE)
    if read is not None and lengths[obs_type] != read.shape[0] in lengths.values():  # SmolVLA fills up other lengths
        raise InputError(
            f"The policy reads a state of {read.shape[0]} numbers; where it acts, obs_type '{obs_type}' has "
            f"{lengths[obs_type]}."
        )
    camera, shown = getattr(policy, "camera", None), OBS_TYPES[obs_type]  # others look at whatever they are shown
    cameras = {*camera.split("+")} if camera else set()
    if not cameras <= {*shown}:
        raise InputError(
            f"The policy reads camera '{camera}'; where it acts, obs_type '{obs_type}' has {', '.join(shown)}."
        )
    if recorded is not None and not cameras <= {*recorded}:
        raise InputError(
            f"The policy reads camera '{camera}'; the demonstrations are recorded by {', '.join(recorded)}."
        )


@dataclass(frozen=True, eq=False)
class Checkpoints(Node):
    """The checkpoints of the training seeds of one computation; the folder `seed_N` holds the checkpoint of seed N.

    Args:
        learner: what is trained.
        training: how.
        seeds: every seed of the computation.
        demonstrations: what it is trained on, without every `training.holdout`-th episode.
    """

    learner: Learner
    training: Training
    seeds: range
    demonstrations: Node

    kind = "checkpoints"

    @classmethod
    def holding(
        cls, seed: int, learner: Learner, training: Training, demonstrations: Node, alone: bool = False
    ) -> "Checkpoints":
        """The node that holds the checkpoint of a seed.

        Args:
            alone: train the seed by itself, also where its trainer stacks seeds.
        """
        stack = 1 if alone else learner.trainer.stack(learner.config)
        first = seed // stack * stack
        return cls(learner, training, range(first, first + stack), demonstrations)

    @property
    def is_single_threaded(self) -> bool:
        return self.learner.trainer.is_single_threaded(self.learner.config)

    def facts(self) -> dict[str, Any]:
        seeds = [self.seeds.start, self.seeds.stop]
        return {"policy": self.learner.facts(), "training": asdict(self.training), "seeds": seeds}

    def versions(self) -> dict[str, str]:
        return versions(*LEARNING) | code_of(__name__) | self.learner.versions()

    @cached_property
    def inputs(self) -> dict[str, Node]:
        return {"data": self.learner.trainer.learns_from(self.learner.config, self.demonstrations)}

    def make(self, folder: Path, inputs: Mapping[str, Path], machine: Machine) -> None:
        """Train the seeds. Raises whatever the trainer raises."""
        flush_denormals()
        dataset = LeRobotDataset(self.inputs["data"].repo_id, root=inputs["data"])
        kept_out = held_out_of(dataset, self.training.holdout)
        folder.mkdir()
        config = deepcopy(self.learner.config)  # which a trainer may change
        made_of = self.learner.trainer.fit(config, dataset, self.seeds, self.training, kept_out, folder)
        for seed in self.seeds:
            facts = {"seed": seed, "training": asdict(self.training), "made_of": made_of}
            (checkpoint_of(seed, folder) / FACTS).write_text(json.dumps(facts) + "\n", encoding="utf-8")


def checkpoint_of(seed: int, folder: Path) -> Path:
    """The checkpoint of a seed in the folder of a `Checkpoints` node."""
    return folder / f"seed_{seed}"
