"""The author's file: found, loaded, watched, compared with its last version, opened as envs. Only a worker executes it."""
