"""How processes are started, spoken to, confined and ended."""
