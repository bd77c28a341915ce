"""The session of the open task: its state, its versions, its timeline."""
