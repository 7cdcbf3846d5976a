"""Numbers to push down: tensors in, one scalar out."""
