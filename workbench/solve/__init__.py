"""Solves the task by planning: the source of actions, the many seeds, and the job."""
