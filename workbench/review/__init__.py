"""Open recordings, played along one time axis."""
