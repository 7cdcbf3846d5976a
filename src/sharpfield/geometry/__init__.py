"""Pure functions of poses and space."""
