"""Reads the configuration of a policy of any installed package, from plain fields or from a checkpoint.

All installed plugins are imported first, because they register the types of policies.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.utils import auto_select_torch_device

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.files import Json
from lerobot_constructskill.lerobot_internals import load_plugins
from lerobot_constructskill.parsing import as_input, check_same, decode

CONFIGURATION = Json("a policy's configuration")


def decode_policy(fields: Mapping[str, Any]) -> PreTrainedConfig:
    """The configuration of these fields, `type` among them.

    Raises:
        InputError: they do not make one, or no installed package has the type.
    """
    load_plugins()
    if "type" in fields and fields["type"] not in [*PreTrainedConfig.get_known_choices()]:
        raise _unknown(fields["type"])
    return decode(PreTrainedConfig, {"device": str(auto_select_torch_device()), **fields})


def read_policy(checkpoint: Path | str, **overrides: Any) -> PreTrainedConfig:
    """The configuration of a checkpoint, a folder or a name on the Hub.

    Args:
        overrides: fields in place of its own, where they are not None.

    Raises:
        InputError: it cannot be read, or no installed package has its type.
        OSError: there is no such checkpoint.
    """
    load_plugins()
    flags = [f"--{name}={value}" for name, value in overrides.items() if value is not None]
    saved = CONFIGURATION.read(file) if (file := Path(checkpoint) / "config.json").exists() else {}
    with as_input():
        try:
            config = PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=flags)
        except ValueError as error:
            if isinstance(error.__cause__, KeyError):  # of LeRobot's registry
                raise _unknown(error.__cause__.args[0]) from error
            raise
        check_same(config, saved, f"'{file}': policy")
    return config


def _unknown(kind: str) -> InputError:
    return InputError(
        f"No installed package has the policy type '{kind}': install the LeRobot plugin that has it, a distribution "
        "whose name begins with lerobot_policy_. One that cannot be imported is in the log above."
    )
