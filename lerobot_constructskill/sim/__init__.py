"""The only room that imports SAPIEN and ManiSkill: scenes, robot, rendering, perturbations of the scene."""

from lerobot_constructskill.sim.drivers import show_all_drivers

show_all_drivers()  # SAPIEN, which every other module here imports, chooses among them when it is imported
