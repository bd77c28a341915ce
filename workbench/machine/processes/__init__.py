"""Starts, confines and ends processes, and carries their messages."""
