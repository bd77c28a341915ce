"""Recordings read in confined processes."""
