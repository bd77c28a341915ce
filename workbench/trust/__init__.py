"""Decides whether code that a recording names or holds may run."""
