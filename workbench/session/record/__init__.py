"""Episodes kept from a live session, while they happen or afterwards."""
