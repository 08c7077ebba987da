"""Marker files in and out: TRC and C3D both ways, Motive CSV in."""
