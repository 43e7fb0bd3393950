"""Imported first by a fork server: torch, which LeRobot's imports ask for a GPU, does not initialise CUDA there.

torch then asks the driver's NVML instead.
"""

import os

os.environ["PYTORCH_NVML_BASED_CUDA_CHECK"] = "1"
