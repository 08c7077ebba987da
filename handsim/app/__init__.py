"""What commands share: what they say, how they end, and who does their work."""
