"""The worker process: its entry, its loop, and the process that forks it."""
