"""Checks a task: the items of a check, the work of one process, and the report."""
