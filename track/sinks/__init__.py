"""Live output: tracked frames go to other programs as they are made."""
