"""Live tracking: people who come and go, what is sent, and what is recorded."""
