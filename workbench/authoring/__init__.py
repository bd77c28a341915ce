"""From the author's file to a task class, and edits back into the file. Executes nothing but in `loading`."""
