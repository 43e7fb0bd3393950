"""Registers `--policy.type=frozen_vit` and `--env.type=constructskill`: import this from a script of your own."""

from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.errors import print_user_errors_of_lerobot
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig

print_user_errors_of_lerobot()

__all__ = ["ConstructSkillEnvConfig", "FrozenViTChunkConfig"]
