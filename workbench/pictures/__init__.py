"""Places, renders, measures and searches cameras of a running env."""
