"""Rerun recordings, and rerun's viewer."""
