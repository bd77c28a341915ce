"""One port, one gate: what a browser may ask and what it gets."""
