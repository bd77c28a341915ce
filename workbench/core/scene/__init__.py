"""What a built scene is made of, its shapes for a page, and simplified ones for fast pictures."""
