"""The rules: a function each, in files by hook."""
