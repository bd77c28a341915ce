"""Solves the task by planning: as a source of actions, from many seeds, and as a job."""
