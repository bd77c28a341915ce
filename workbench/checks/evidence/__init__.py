"""What the rules look at: envs of a version, what they did, and lines of the source."""
