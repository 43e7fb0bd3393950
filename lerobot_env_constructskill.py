"""LeRobot imports every installed `lerobot_env_*` distribution by name; this registers ours."""

from lerobot_constructskill import plugin  # noqa: F401
