"""ManiSkill's own trajectory files, written and read."""
