"""Rescores the history and recordings with the current code."""
