"""The batched env core: N envs of one ManiSkill task, on the CPU or a GPU. Independent of page, file formats and processes."""
