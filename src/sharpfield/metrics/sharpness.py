"""How sharp a picture is, without another to compare it to.

Both numbers grow with contrast and noise as well as with sharpness, so they order pictures of the
same scene under the same light, and mean nothing on their own.
"""

import torch
from jaxtyping import Float
from torch import Tensor

REC601 = (0.299, 0.587, 0.114)


def luma(picture: Float[Tensor, "*b c"]) -> Float[Tensor, "*b"]:
    """Brightness of display values: Rec. 601 for three channels, the channel itself for one."""
    if picture.shape[-1] == 1:
        return picture[..., 0]
    return picture @ picture.new_tensor(REC601)


def laplacian_variance(picture: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Variance of the Laplacian (four neighbours) of the luma, inside the border.

    Source: Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy", ICPR 2000.
    """
    grey = luma(picture).double()
    middle = grey[1:-1, 1:-1]
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * middle
    return laplacian.var(correction=0)


def gradient_energy(picture: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Mean squared length of the gradient of the luma, per pixel, by forward differences."""
    grey = luma(picture).double()
    right = grey[:-1, 1:] - grey[:-1, :-1]
    down = grey[1:, :-1] - grey[:-1, :-1]
    return torch.mean(right.square() + down.square())
