"""Event images: values at scattered positions, summed into the pixels of an image.

Positions are in index units (10.0 is the centre of pixel 10); values outside are dropped.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float32, Float64
from numba import njit

from sharpfield.events.index import EventIndex, counts, window


def splat_nearest(
    xy: Float32[np.ndarray, "m 2"], value: Float64[np.ndarray, "m c"], *, width: int, height: int
) -> Float64[np.ndarray, "h w c"]:
    """Add each value to the pixel whose centre is nearest (halves go to the higher pixel)."""
    image = np.zeros((height, width, value.shape[1]))
    _nearest(xy, value, image)
    return image


def splat_bilinear(
    xy: Float32[np.ndarray, "m 2"], value: Float64[np.ndarray, "m c"], *, width: int, height: int
) -> Float64[np.ndarray, "h w c"]:
    """Distribute each value to the four pixels around it, with weights (1 - |dx|) (1 - |dy|)."""
    image = np.zeros((height, width, value.shape[1]))
    _bilinear(xy, value, image)
    return image


def window_image(
    index: EventIndex, start_us: int, end_us: int, *, width: int, height: int, track: int = 0
) -> Float64[np.ndarray, "h w 2"]:
    """Numbers of OFF and ON events of each pixel with start <= t < end.

    Rectified positions are distributed bilinearly, so that counts need not be whole numbers.

    Args:
        index: The events.
        start_us: Included.
        end_us: Excluded.
        width: Of the image.
        height: Of the image.
        track: Whose events.
    """
    site = index.sites_of(track)
    start, end = np.full(len(site), start_us), np.full(len(site), end_us)
    found = counts(index, *window(index, site, start, end))
    value = np.stack(found, -1).astype(np.float64)
    return splat_bilinear(index.site_xy[site], value, width=width, height=height)


@njit(cache=True, nogil=True)
@no_type_check
def _add(image: Float[np.ndarray, "h w c"], row, column, weight, value) -> None:
    if 0 <= row < image.shape[0] and 0 <= column < image.shape[1]:
        for c in range(image.shape[2]):
            image[row, column, c] += weight * value[c]


@njit(cache=True, nogil=True)
@no_type_check
def _nearest(xy, value, image):
    for i in range(len(xy)):
        column, row = int(np.floor(xy[i, 0] + 0.5)), int(np.floor(xy[i, 1] + 0.5))
        _add(image, row, column, 1.0, value[i])


@njit(cache=True, nogil=True)
@no_type_check
def _bilinear(xy, value, image):
    for i in range(len(xy)):
        left, top = int(np.floor(xy[i, 0])), int(np.floor(xy[i, 1]))
        right, below = xy[i, 0] - left, xy[i, 1] - top
        for row, weight in ((top, 1 - below), (top + 1, below)):
            _add(image, row, left, weight * (1 - right), value[i])
            _add(image, row, left + 1, weight * right, value[i])
