"""How processes are started, confined and ended, and their messages."""
