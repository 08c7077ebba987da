"""Live streams of points."""
