"""The YAML of our own configuration files, in which `!policy` stands for the fields of a shipped policy.

`!policy precise` is the fields of `configs/policy/precise.yaml`; `!policy {preset: precise, camera: base}` is the same
with another value. The tag has a meaning for `Loader` alone: PyYAML's own loaders refuse it, as they always do.
"""

from pathlib import Path
from typing import Any

import yaml

from lerobot_constructskill import files
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.files import read_text
from lerobot_constructskill.presets import find


class Loader(files.Loader):
    """`files.Loader` with `!policy`, which takes names of shipped policies and opens no other file."""

    own_tags = frozenset({"!policy"})


def _policy(loader: Loader, node: yaml.Node) -> dict[str, Any]:
    if isinstance(node, yaml.ScalarNode):
        name, fields = node.value, {}
    else:
        fields = loader.construct_mapping(node, deep=True)
        if "preset" not in fields:
            raise InputError("`!policy {…}` must name the policy that it starts from, such as `preset: precise`.")
        name = fields.pop("preset")
    return read(find("policy", str(name), or_file=False)) | fields


Loader.add_constructor("!policy", _policy)


def read(path: Path | str) -> Any:
    """The content of a configuration file as plain values.

    Raises:
        MissingError: there is no such file, or a `!policy` in it names no shipped policy.
        InputError: a `!policy` in it names none at all, or it is not what `files.Loader` reads.
    """
    return files.parse_yaml(read_text(Path(path), files.MOST_YAML), f"'{path}'", Loader)
