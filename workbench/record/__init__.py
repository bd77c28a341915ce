"""Records episodes: live, from the history, in a job, or from a script."""
