"""Panels of the live page: Run, Reward, Envs, Inspect, Log, timeline."""
