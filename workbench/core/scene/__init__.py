"""What a built scene is made of, and its shapes for a page."""
