"""Marker files in and out: TRC and C3D both ways, Motive CSV in."""

from gloves.captures.capture import READABLE, WRITABLE, Capture, read_capture, write_capture

__all__ = ["READABLE", "WRITABLE", "Capture", "read_capture", "write_capture"]
