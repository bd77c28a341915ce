"""From a source file to a running task class, and what went wrong in it."""
