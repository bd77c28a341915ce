"""The author's file and its modules: found, trusted, executed, registered, watched."""
