"""From a measurement to the sharp rays behind it, and from their light to what is reported."""
