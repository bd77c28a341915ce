"""Arguments that all commands share, and how commands print and ask."""
