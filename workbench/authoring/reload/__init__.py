"""What a save changed, and the least that must be done about it."""
