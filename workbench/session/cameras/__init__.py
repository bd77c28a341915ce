"""The camera studio: cameras placed by hand, judged, and written into the file."""
