"""Work that needs no page: a task opened, recorded, replayed and rescored, in one process or several."""
