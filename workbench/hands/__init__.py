"""Hands in the scene: move and pull the selected body."""
