"""Plays open recordings along one time axis."""
