"""The one door to the configuration of a policy, of plain fields or of a checkpoint, whoever wrote the policy.

All plugins that are installed are imported first, so a command that reads a policy knows the types of others.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.utils import auto_select_torch_device

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.files import Json
from lerobot_constructskill.lerobot_internals import load_plugins
from lerobot_constructskill.parsing import as_input, check_kinds, decode

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
    if (file := Path(checkpoint) / "config.json").exists():
        saved = CONFIGURATION.read(file)
        try:
            check_kinds(PreTrainedConfig, saved)
        except InputError as error:
            raise InputError(f"'{file}': {error}") from None
    with as_input():
        try:
            return PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=flags)
        except ValueError as error:
            if isinstance(error.__cause__, KeyError):  # of LeRobot's registry
                raise _unknown(error.__cause__.args[0]) from error
            raise


def _unknown(kind: str) -> InputError:
    return InputError(
        f"No installed package has the policy type '{kind}': install the LeRobot plugin that has it, a distribution "
        "whose name begins with lerobot_policy_. One that cannot be imported is in the log above."
    )
