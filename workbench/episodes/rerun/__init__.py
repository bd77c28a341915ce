"""Rerun's files and viewer."""
