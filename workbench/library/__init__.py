"""The library: all recordings below a folder, as a table."""
