"""The Cameras and Studio tabs."""
