"""Work that needs no page: cut into numbered items, done by several processes."""
