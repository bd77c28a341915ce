"""Finds where the values of a running call are written in the source, and edits them."""
