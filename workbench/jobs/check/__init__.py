"""Checks a task: what a check is, what one process of it does, and what all come to."""
