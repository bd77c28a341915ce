"""Data read from a running env: for a person, and for a recording."""
