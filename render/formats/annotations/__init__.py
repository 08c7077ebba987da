"""Ground truth of rendered frames in the JSON of other data sets."""
