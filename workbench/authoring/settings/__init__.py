"""Constants and constructor arguments of the author's file: found by reading it, and constants given other values."""
