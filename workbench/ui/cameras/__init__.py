"""The Cameras and Studio tabs, and cameras in the 3D view."""
