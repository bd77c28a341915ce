"""The panels of the live page."""
