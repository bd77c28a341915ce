"""The rules: one function for each, in files by hook."""
