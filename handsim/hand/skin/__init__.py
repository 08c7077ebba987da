"""The skin: a smooth closed mesh that is a function of the shape."""
