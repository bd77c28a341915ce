"""Serves the page on one port: who may connect, what a browser may send, and what it gets."""
