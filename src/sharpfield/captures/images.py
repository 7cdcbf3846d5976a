"""Still images of captures: those of `storage.images`, which recordings read as well."""

from sharpfield.storage.images import (
    SUFFIXES,
    Alpha,
    Image,
    Images,
    describe,
    list_images,
    read_image,
    read_images,
    write_image,
)

__all__ = [
    "SUFFIXES",
    "Alpha",
    "Image",
    "Images",
    "describe",
    "list_images",
    "read_image",
    "read_images",
    "write_image",
]
