"""Serves the page on one port: who may connect, what a browser may ask, and what it gets."""
