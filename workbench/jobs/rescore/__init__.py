"""Rescores recorded runs with another version of their task, and says what differs."""
