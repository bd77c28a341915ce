"""Puts state, commands, worker and pages together."""
