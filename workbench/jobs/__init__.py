"""Deals the items of a job to workers in this process, in other processes, or on a Ray cluster."""
