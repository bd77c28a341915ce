"""What all commands take, and how they print and ask."""
