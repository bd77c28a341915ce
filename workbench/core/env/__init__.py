"""A task as N envs: made, stepped, reset in part, exchanged for a new version, and checked by the rules."""
