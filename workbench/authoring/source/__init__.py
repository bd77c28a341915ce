"""Values traced to where they stand in the author's files, and smallest edits of them."""
