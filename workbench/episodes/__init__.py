"""Episodes on disk: their columns and documents, replay, films, and the results of a sweep."""
