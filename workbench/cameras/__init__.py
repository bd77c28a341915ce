"""The Cameras tab: place cameras, measure what they see, write them into the file."""
