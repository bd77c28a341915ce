"""Cameras of a running env: placed, rendered, measured and searched for."""
