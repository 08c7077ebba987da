"""What an optical system sees of markers."""
