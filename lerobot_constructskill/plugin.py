"""Registers `--policy.type=frozen_vit` and `--env.type=constructskill`: import this from a script of your own.

In LeRobot's YAML files it also gives a meaning to `!held_out_last 80`: episodes 0 to 79 with the held-out ones last,
which is where LeRobot's `dataset.eval_split` takes its part.
"""

import yaml

from lerobot_constructskill.contract import held_out_last
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.lerobot_internals import FullLoaderWithInclusion
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig

__all__ = ["ConstructSkillEnvConfig", "FrozenViTChunkConfig"]

# LeRobot reads a file by the first loader to look for `policy.path`, and by the second to parse it.
for _loader in (yaml.SafeLoader, FullLoaderWithInclusion):
    _loader.add_constructor("!held_out_last", lambda loader, node: held_out_last(int(loader.construct_scalar(node))))
