"""Records episodes: while they run, from the history, in a job, or from a script."""
