"""A hand that holds an object."""
