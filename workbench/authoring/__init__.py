"""From the author's file to a task class, and edits back into the file. In the server it executes nothing; in the worker
`loading` runs the file, `run_hooks` its camera hooks, and `read_values` evaluates its expressions."""
