"""The page. Nothing else knows viser."""
