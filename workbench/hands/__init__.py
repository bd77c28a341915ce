"""Moves bodies and robots by hand."""
