"""Plans actions with rollouts of the author's own task, and reports what the rollouts show about its reward."""
