"""What the authors measure, no part of the installed packages: `python -m benchmarks.NAME` from the root."""
