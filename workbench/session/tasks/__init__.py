"""The tasks to choose from: recent ones, those of a folder, ManiSkill's own and examples."""
