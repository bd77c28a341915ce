"""The run: what the worker that plays has loaded, how it goes, and its past."""
