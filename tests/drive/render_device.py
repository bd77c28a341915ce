"""The device on which this machine's tests render: SAPIEN allows one per process, under one name."""

import torch

RENDER_DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
"""SAPIEN's name for the device."""
RENDER_BACKEND = "gpu" if torch.cuda.is_available() else "cpu"
"""ManiSkill's name for the device, for ``render_backend``."""
