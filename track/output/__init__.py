"""What is sent and recorded of tracked frames: messages, sinks and takes."""
