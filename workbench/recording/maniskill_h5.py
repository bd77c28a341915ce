"""ManiSkill's own trajectory files: an ``.h5`` with the columns and a ``.json`` that says what they are of.

One episode a file, ``traj_0``. The ``.json`` is ManiSkill's (``env_info``, ``commit_info``, ``episodes``) with one key more, ``workbench``:

    format 1; id, task, env_index, seed (null where unknown), source_file (name), source_path (as seen from the recording's
    folder; null), source_hash, source {path: text}, control_dt, control_mode, backend, versions, env_kwargs, reset_options,
    max_episode_steps, written_at, recovered (all as in `EpisodeInfo`);
    length, return, success, success_once, fail, fail_once (null where the task has no such entry);
    action_names, thumbnail (base64 of a JPEG at most 160 pixels wide; null without cameras), cameras, segmentation, scene, evaluate.

So whoever lists recordings reads ``.json`` files and nothing else.
"""
