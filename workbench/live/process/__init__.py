"""The worker as a process: started, supervised, asked and logged; and background jobs with their progress."""
