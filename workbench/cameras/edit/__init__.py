"""Writes a camera into the author's file as the smallest edit."""
