"""From disk to captures, and from captures to what a training step looks at."""
