"""Importing this registers every task of the contract table with ManiSkill (and so with Gymnasium)."""

from importlib import import_module

from lerobot_constructskill.contract import TASKS

for _task in TASKS.values():
    import_module(_task.scene.split(":")[0])
