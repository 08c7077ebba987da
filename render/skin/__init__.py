"""The skin of a drawn hand: its mesh on a forearm, and the texture on it."""
