"""The YAML of our own configuration files, in which `!policy` stands for the fields of a shipped policy.

`!policy precise` is the fields of `configs/policy/precise.yaml`; `!policy {preset: precise, camera: base}` is the same
with another value. The tag has a meaning for `Loader` alone: PyYAML's own loaders refuse it, as they always do.
"""

from pathlib import Path
from typing import Any

import yaml

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.presets import named

MERGE = "tag:yaml.org,2002:merge"

MOST_VALUES = 100_000
"""In a file, with those that its aliases stand for: a few hundred bytes of aliases can stand for billions."""


class Loader(yaml.SafeLoader):
    """PyYAML's safe loader with `!policy`, which takes names of shipped policies and opens no other file.

    A key that stands twice is refused: PyYAML keeps the last one alone.
    """

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if node is not None and _count(node, {}) > MOST_VALUES:
            raise InputError(f"'{self.name}' stands for more than {MOST_VALUES} values: its aliases multiply.")
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        known = set()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode) and key.tag != MERGE):
            if key.value in known:
                line = key.start_mark.line + 1
                raise InputError(f"'{self.name}', line {line}: '{key.value}' stands there a second time; keep one.")
            known.add(key.value)
        return super().construct_mapping(node, deep)


def _count(node: yaml.Node, counted: dict[int, int]) -> int:
    """The values that a node stands for. What it holds itself, which YAML allows, counts as too many."""
    if id(node) not in counted:
        counted[id(node)] = MOST_VALUES + 1
        parts = node.value if isinstance(node, yaml.CollectionNode) else ()
        parts = [one for part in parts for one in (part if isinstance(part, tuple) else (part,))]
        counted[id(node)] = 1 + sum(_count(part, counted) for part in parts)
    return counted[id(node)]


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
        InputError: a `!policy` in it names none at all, a key stands twice, or it is too large or too deep.
        yaml.YAMLError: it is no YAML.
    """
    with open(path, encoding="utf-8") as file:
        try:
            return yaml.load(file, Loader)
        except RecursionError:
            raise InputError(f"'{path}' is nested too deeply.") from None
