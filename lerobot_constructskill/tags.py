"""The YAML of our own configuration files, in which `!policy` stands for the fields of a shipped policy.

`!policy precise` is the fields of `configs/policy/precise.yaml`; `!policy {preset: precise, camera: base}` is the same
with another value. The tag has a meaning for `Loader` alone: PyYAML's own loaders refuse it, as they always do.
"""

from pathlib import Path
from typing import Any

import yaml

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.presets import named


class Loader(yaml.SafeLoader):
    """PyYAML's safe loader with `!policy`, which takes names of shipped policies and opens no other file."""


def _policy(loader: Loader, node: yaml.Node) -> dict[str, Any]:
    if isinstance(node, yaml.ScalarNode):
        name, fields = node.value, {}
    else:
        fields = loader.construct_mapping(node, deep=True)
        if "preset" not in fields:
            raise InputError("`!policy {…}` must name the policy that it starts from, such as `preset: precise`.")
        name = fields.pop("preset")
    return yaml.safe_load(named("policy", str(name)).read_text()) | fields


Loader.add_constructor("!policy", _policy)


def read(path: Path | str) -> Any:
    """The content of a configuration file as plain values.

    Raises:
        OSError: the file cannot be opened.
        MissingError: a `!policy` in it names no shipped policy.
        InputError: a `!policy` in it names none at all.
        yaml.YAMLError: it is no YAML.
    """
    with open(path, encoding="utf-8") as file:
        return yaml.load(file, Loader)
