"""New task files, made from the examples and from installed tasks."""
