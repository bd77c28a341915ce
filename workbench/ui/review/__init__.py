"""Panels and 3-D view of the review page."""
