"""Registers `--policy.type=frozen_vit` and `--env.type=constructskill`: import this from a script of your own."""

from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig

__all__ = ["ConstructSkillEnvConfig", "FrozenViTChunkConfig"]
