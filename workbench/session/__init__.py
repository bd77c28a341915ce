"""The live session: the worker process that owns the env, the messages to it, and the player."""
