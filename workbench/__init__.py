"""Workbench: an interactive authoring workbench for ManiSkill tasks."""

__version__ = "0.1.0"
