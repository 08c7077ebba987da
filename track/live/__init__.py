"""Live tracking, of people who come and go."""
