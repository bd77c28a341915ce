"""Deals the items of a job to workers in this process, in others, or on a Ray cluster."""
