"""From surfaces and lamps to colors, depth and ids."""
