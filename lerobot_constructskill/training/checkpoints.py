"""Checkpoints in a store: a policy's fields settled, what a checkpoint is found by, and what it says of its making."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypedDict

from lerobot.configs import PreTrainedConfig
from lerobot.utils import OBS_STATE

from lerobot_constructskill.artifacts.code import check_unedited
from lerobot_constructskill.artifacts.digests import versions
from lerobot_constructskill.artifacts.store import Artifact, Store
from lerobot_constructskill.contract import OBS_TYPES
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.files import Json
from lerobot_constructskill.policy_types import decode_policy
from lerobot_constructskill.training.recipe import Training
from lerobot_constructskill.training.trainers import policy_spec, trainer_of, versions_of

LEARNING = ("lerobot", "torch", "numpy")
"""Packages whose versions may show in any checkpoint."""

ACTING = (*LEARNING, "mani_skill", "sapien")
"""Packages whose versions may show in what any agent does."""

FACTS = "training.json"
"""In a checkpoint's folder: what its trainer says of it."""


class _Facts(TypedDict, total=False):
    heldout_mse_m2: float | None
    made_of: dict[str, str]


SAID = Json("what a trainer says of a checkpoint", _Facts)


def settle_policy(fields: Mapping[str, Any]) -> PreTrainedConfig:
    """The configuration of these fields, with everything written out that it leaves to the machine."""
    config = decode_policy(fields)
    return trainer_of(config).settle(config)


def settled_elsewhere(fields: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The same fields for each other kind of machine, with that written out which it would settle otherwise."""
    config = decode_policy(fields)
    return [{**fields, **others} for others in trainer_of(config).settled_elsewhere(config)]


def check_inputs(policy: PreTrainedConfig, obs_type: str) -> None:
    """Refuse a policy that reads what it would not be shown where it acts.

    Raises:
        InputError: it reads the state, and observations have pictures alone, or a camera that they do not have.
    """
    # LeRobot gives a policy that does not name its inputs all of the data set; its own types read the state in it.
    unsaid = getattr(policy, "use_state", type(policy).__module__.startswith("lerobot."))
    reads_state = OBS_STATE in policy.input_features if policy.input_features else unsaid
    if reads_state and obs_type == "pixels":
        raise InputError("The policy reads observation.state; where it acts, obs_type has to be 'pixels_agent_pos'.")
    camera, shown = getattr(policy, "camera", None), OBS_TYPES[obs_type]  # others look at whatever they are shown
    if camera not in (None, *shown):
        raise InputError(
            f"The policy reads camera '{camera}'; where it acts, obs_type '{obs_type}' has {', '.join(shown)}."
        )


def checkpoint_artifact(
    policy: PreTrainedConfig, training: Training, seed: int, demonstrations: Mapping[str, Any], stack: int
) -> Artifact:
    """What a training seed of a settled policy makes of demonstrations with this specification.

    Args:
        stack: how many seeds are trained as one computation, `Trainer.stack` or 1.
    """
    facts = {"policy": policy_spec(policy), "training": asdict(training), "seed": seed, "stack": stack}
    made_by = versions(*LEARNING) | versions_of(policy)
    return Artifact("checkpoints", facts | {"demonstrations": demonstrations, "versions": made_by})


@contextmanager
def writing_checkpoint(store: Store, checkpoint: Artifact, policy: PreTrainedConfig, **facts: Any) -> Iterator[Path]:
    """A `trainers.Writer`, but for its first three arguments.

    Raises:
        MachineError: the policy's code is not what it was when the checkpoint was asked for.
    """
    with store.writing(checkpoint) as folder:
        yield folder
        check_unedited(checkpoint.spec["versions"], versions_of(policy))
        (folder / FACTS).write_text(json.dumps(facts) + "\n", encoding="utf-8")


def read_facts(checkpoint: Path) -> _Facts:
    """What a checkpoint says of its training. Raises InputError where its file is damaged."""
    file = checkpoint / FACTS
    return SAID.read(file) if file.exists() else {}
