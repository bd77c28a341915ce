"""The page: viser and nothing else talks to the browser."""
