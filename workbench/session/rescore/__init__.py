"""Past moments and recordings rescored with today's code."""
