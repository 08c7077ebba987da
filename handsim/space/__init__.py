"""Space around the hand: frames, cameras and objects."""
