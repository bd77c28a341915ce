"""All recordings below a folder, as a table."""
