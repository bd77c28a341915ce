"""Episodes on disk: written, read, listed, and made into films and datasets."""
