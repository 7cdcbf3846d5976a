"""Files that captures and recordings both read and write: events, images, arrays, the disk cache."""
