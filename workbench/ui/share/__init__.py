"""The Share tab: films, pages, sheets and datasets made from recordings, and rerun's viewer."""
