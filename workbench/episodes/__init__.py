"""Episodes on disk: columns, documents, replay, films, and sweep results."""
