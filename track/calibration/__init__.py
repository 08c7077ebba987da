"""Estimates the shape of a user's hands, and where the glove's markers sit, from captures."""
