"""Imported first by a fork server: torch then asks NVML whether there is a GPU, and does not initialise CUDA."""

import os

os.environ["PYTORCH_NVML_BASED_CUDA_CHECK"] = "1"
