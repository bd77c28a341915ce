"""Where values of a running call stand in the source, and edits of them."""
