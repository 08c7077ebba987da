"""Two hands, and a hand beside an object in the other."""
