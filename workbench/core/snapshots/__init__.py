"""Everything that decides how an episode goes on, kept and put back."""
