"""The worker as a process: started, supervised, asked and logged; and jobs in the background with their progress."""
