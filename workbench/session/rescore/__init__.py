"""Rescores past moments and recordings with today's code."""
