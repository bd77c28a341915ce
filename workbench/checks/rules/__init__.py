"""The rules, one function each, by the hook that they guard."""
