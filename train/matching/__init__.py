"""From what a network says of points to one label per point, checked against hands that exist."""
