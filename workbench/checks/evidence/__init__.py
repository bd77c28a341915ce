"""What the checks look at: envs of a version, what they were seen to do, and lines of the source."""
