"""The library: a table of all recordings below a folder."""
