"""The rules, a function each, by the hook that they guard, and what runs them."""
