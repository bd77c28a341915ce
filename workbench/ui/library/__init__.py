"""The library of recordings as a table."""
