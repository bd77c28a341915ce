"""The camera studio: places cameras, measures what they see, and writes them into the file."""
