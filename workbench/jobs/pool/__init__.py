"""Deals items to workers in this process, in others, or on a cluster, and keeps their results in a job file."""
