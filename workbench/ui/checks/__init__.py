"""The Checks tab: rules that the task breaks, and the time of each part of a step."""
