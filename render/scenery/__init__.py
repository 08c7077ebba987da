"""What is around the hands: backgrounds and light."""
