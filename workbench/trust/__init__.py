"""Decides whether code that a recording references or contains may run."""
