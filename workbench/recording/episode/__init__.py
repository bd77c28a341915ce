"""One episode as columns, and what its files say of it."""
