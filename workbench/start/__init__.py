"""The list of tasks to open, and new tasks."""
