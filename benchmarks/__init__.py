"""What things cost, measured; each file says by which command."""
