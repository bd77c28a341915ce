"""The worker process: start, supervision, questions and captured output; and background jobs with their progress."""
