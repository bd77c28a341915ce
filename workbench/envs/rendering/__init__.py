"""Shaders, and simplified shapes for fast pictures."""
