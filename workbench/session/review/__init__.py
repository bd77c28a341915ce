"""Recordings that are open, along one time axis."""
