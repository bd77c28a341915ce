"""Records episodes of a live session, while they happen or afterwards."""
