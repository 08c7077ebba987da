"""Gloves learned from recordings of hands that wear them."""
