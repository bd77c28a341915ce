"""Plans actions by rollouts of the author's own task, and says what the rollouts tell of its reward."""
