"""A LeRobot plugin: importing it registers `--policy.type=tinybc`."""

from lerobot_policy_tinybc.configuration_tinybc import TinyBCConfig

__all__ = ["TinyBCConfig"]
