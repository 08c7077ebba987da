"""Training data: files, batches and their augmentation."""
