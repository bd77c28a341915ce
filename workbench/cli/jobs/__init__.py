"""The commands whose work is cut into items: where it runs, how it is reported."""
