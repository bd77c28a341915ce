"""Rescores the history and recordings with today's code."""
