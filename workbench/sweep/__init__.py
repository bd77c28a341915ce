"""Records a task with each of several values of its constants, and shows the results."""
