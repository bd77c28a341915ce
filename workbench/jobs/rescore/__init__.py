"""Rescores recorded runs with another version of their task, and lists the differences."""
