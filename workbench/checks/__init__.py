"""Checks a task against rules, on the page and in jobs, and times a control step."""
