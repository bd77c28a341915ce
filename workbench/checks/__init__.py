"""Checks of a task: what is wrong with it is said before a cluster says it."""
