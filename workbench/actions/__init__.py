"""Sources of actions: random, zero, hold, sliders, policies, planning, and files."""
