"""An episode while it happens: the crash-safe journal, and the files that are made of it."""
