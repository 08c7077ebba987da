"""Takes after they are tracked: smoothed, judged, summed up, corrected and shown on a page."""
