"""Registers `--policy.type=frozen_vit` and `--env.type=constructskill`: import this from a script of your own.

In LeRobot's YAML files it also gives a meaning to `!held_out_last` and `!policy` (tags.py).
"""

from lerobot_constructskill import tags  # noqa: F401
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig

__all__ = ["ConstructSkillEnvConfig", "FrozenViTChunkConfig"]
