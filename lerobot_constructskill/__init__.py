"""ConstructSkill for LeRobot. A room imports only from rooms below it (`tests/test_architecture.py` holds them to it).

scripts     console commands
board       submissions, their replay, the leaderboard
comparison  two sides judged over training seeds
analysis    rows in, page out: statistics and report
study       runs, made where they are missing
dagger      rounds that a policy drives and the expert labels
rollout     agents in lockstep, references, simulators, errors offline
dataset     reads a finished data set: checks, card, plots, Hub
demos       experts, noise, recorder
training    how any LeRobot policy is trained and validated in a study
features    a data set through an encoder, once; frozen_vit's trainer
envs        what LeRobot sees
sim         the simulator
policies    frozen_vit
artifacts   nodes and the store that makes them: specifications, digests, revisions of our code, locks, worker pools
files       how a file is read that another may have written: JSON, YAML, Parquet
parsing     flags and files into configurations; bounds and presets are what it reads by
errors      what is meant for the user
interface   the contract of a task in plain values: units, ranges, frames, cameras
contract    tasks, units and names, each once
"""
