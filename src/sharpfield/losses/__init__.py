"""Numbers to push down: tensors in, one scalar out."""

from typing import TYPE_CHECKING

from sharpfield._lazy import lazily

if TYPE_CHECKING:
    from sharpfield.losses.events import contrast_error as contrast_error
    from sharpfield.losses.events import counted_error as counted_error
    from sharpfield.losses.events import dead_zone_error as dead_zone_error
    from sharpfield.losses.events import scaled_error as scaled_error
    from sharpfield.losses.events import silence_error as silence_error
    from sharpfield.losses.photometric import mse as mse
    from sharpfield.losses.regularizers import smoothness as smoothness

__getattr__, __dir__ = lazily(__name__, __file__, check_shapes=True)
