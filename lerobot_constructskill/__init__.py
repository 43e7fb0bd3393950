"""ConstructSkill for LeRobot. A room imports only from rooms below it (`tests/test_architecture.py` holds them to it).

scripts     console commands, one file each
analysis    rows in, page out: statistics and report
study       runs, made where they are missing
rollout     agents in lockstep, references, simulators
dataset     what one does with a data set that is there
demos       experts, noise, recorder
features    a data set through an encoder, once
envs        what LeRobot sees
sim         the simulator
policies    frozen_vit
artifacts   folders that are found by what made them
contract    tasks, units and names, each once
"""
