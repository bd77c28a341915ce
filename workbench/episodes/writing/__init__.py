"""Writes an episode while it runs: the crash-safe journal, and the files that are made from it."""
