"""Numbers to push down: tensors in, one scalar out."""

from sharpfield.losses.events import BAYER_WEIGHTS, contrast_error, silence_error
from sharpfield.losses.photometric import mse
from sharpfield.losses.regularizers import alignment, smoothness

__all__ = [
    "BAYER_WEIGHTS",
    "alignment",
    "contrast_error",
    "mse",
    "silence_error",
    "smoothness",
]
