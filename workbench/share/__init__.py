"""Films, pages, sheets and datasets made from recordings, and rerun's viewer."""
