"""A camera's settings written into the author's file as the smallest edit."""
