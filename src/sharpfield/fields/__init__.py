"""Fields: what a sharp scene emits, at points, in directions, at times."""
