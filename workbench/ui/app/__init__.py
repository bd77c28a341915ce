"""The two pages put together, and the ways between them."""
