"""A camera's settings written into the author's file, as the smallest edit that says them.

Text in, text out, in the server process, which executes nothing of the author's and imports no simulator. What it knows
of the cameras, and the proof of an edit, comes from a worker that runs the hooks with a text (`Run`; there it is
`run_hooks`). `plan_edit` and its siblings give a `SourceEdit`, to be shown and then handed to `apply`, or raise `Refused`
with the reason and a snippet to copy.
"""
