"""Everything that decides how an episode continues: kept and restored."""
