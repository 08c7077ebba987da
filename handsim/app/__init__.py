"""What commands share: messages, compiled kernels, output folders and workers."""
