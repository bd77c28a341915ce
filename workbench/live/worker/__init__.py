"""Parts of the worker process: it owns the env and is the only one that steps it."""
