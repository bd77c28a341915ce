"""The Checks tab: rules that the task breaks, and where a step goes."""
