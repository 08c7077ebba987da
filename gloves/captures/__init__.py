"""Marker files in and out: TRC, C3D and Motive CSV both ways, Vicon CSV and Qualisys TSV in."""
