"""Snapshots of everything that decides how an episode continues."""
