"""Reads recordings in confined processes."""
