"""Inputs, charts and other parts that panels are made of."""
