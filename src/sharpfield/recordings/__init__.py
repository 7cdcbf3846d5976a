"""A camera's own files, one module per format, opened without being loaded."""
