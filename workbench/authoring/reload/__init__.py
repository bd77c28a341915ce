"""Compares two versions of a task and decides how much of the env must be rebuilt."""
