"""The worker as a process: started, supervised, asked, and what it printed."""
