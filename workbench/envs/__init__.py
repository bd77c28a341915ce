"""The batched env core: N envs of one ManiSkill task, on the CPU or a GPU. Knows no page, no file format and no process."""
