"""The worker as a process: started, supervised, asked, and what it printed; jobs in the background and what is shown of them."""
