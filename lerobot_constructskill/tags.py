"""What two tags mean in YAML files, for LeRobot's own commands and for ours.

`!held_out_last 80` is episodes 0 to 79 with the held-out ones last, which is where LeRobot's `dataset.eval_split`
takes its part. `!policy precise` is the fields of `configs/policy/precise.yaml`; `!policy {preset: precise, camera:
base}` is the same with another value.
"""

from typing import Any

import yaml

from lerobot_constructskill.contract import held_out_last
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.lerobot_internals import FullLoaderWithInclusion
from lerobot_constructskill.presets import find


def _held_out_last(loader: yaml.SafeLoader, node: yaml.Node) -> list[int]:
    return held_out_last(int(loader.construct_scalar(node)))


def _policy(loader: yaml.SafeLoader, node: yaml.Node) -> dict[str, Any]:
    if isinstance(node, yaml.ScalarNode):
        name, fields = node.value, {}
    else:
        fields = loader.construct_mapping(node, deep=True)
        if "preset" not in fields:
            raise InputError("`!policy {…}` must name the policy that it starts from, such as `preset: precise`.")
        name = fields.pop("preset")
    return yaml.safe_load(find("policy", name).read_text()) | fields


# LeRobot reads a file by the first loader to look for `policy.path`, and by the second to parse it.
for _loader in (yaml.SafeLoader, FullLoaderWithInclusion):
    _loader.add_constructor("!held_out_last", _held_out_last)
    _loader.add_constructor("!policy", _policy)
