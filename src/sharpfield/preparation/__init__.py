"""Before training: make the most of a recording."""
