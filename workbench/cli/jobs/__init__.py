"""The commands that run a job in items: where the job runs, and how its results are reported."""
