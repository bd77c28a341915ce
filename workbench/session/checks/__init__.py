"""Checks the rules of the running version in the background, and times a step of it."""
