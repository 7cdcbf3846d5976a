"""Files of captures and recordings alike: events, images, arrays, and the disk cache."""
