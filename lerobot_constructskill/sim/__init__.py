"""The only room that imports SAPIEN and ManiSkill: scenes, robot, rendering, perturbations of the scene."""
