"""Takes: hands over time, what was seen of them and their labels, simulated, tracked or a user's own."""
