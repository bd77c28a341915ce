"""The batched env core: N environments of one ManiSkill task, on CPU or GPU.

Knows ManiSkill, SAPIEN and torch; knows nothing of viser, rerun, files or processes.
"""
