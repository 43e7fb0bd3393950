"""Registers `--policy.type=frozen_vit` and `--env.type=constructskill`: import this from a script of your own."""

from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.errors import end_lerobots_commands_in_one_sentence
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig

end_lerobots_commands_in_one_sentence()

__all__ = ["ConstructSkillEnvConfig", "FrozenViTChunkConfig"]
