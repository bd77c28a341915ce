"""The past of the batch: moments, curves, one row an env."""
