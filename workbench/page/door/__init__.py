"""Serves the page on one port: access control, messages from browsers, HTTP responses."""
