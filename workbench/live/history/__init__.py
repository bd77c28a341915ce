"""The history of the batch: moments, curves, one table row per env."""
