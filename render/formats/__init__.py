"""File formats of rendered frames."""
