"""The Cameras and Studio tabs: place cameras, measure what they see, write them into the file."""
