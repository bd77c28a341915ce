"""Bodies and shapes of a built scene."""
