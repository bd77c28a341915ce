"""Sources of actions: random, zero, hold, sliders, a policy, a plan, or a file."""
