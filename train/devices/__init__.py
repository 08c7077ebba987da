"""Training on many devices: which process this is, its devices, and what the processes agree about."""
