"""Which task is open: the list to choose from, and how its envs are made."""
