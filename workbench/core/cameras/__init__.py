"""Cameras: placed, rendered, measured and searched for."""
