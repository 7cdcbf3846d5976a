"""Small patches of images, each with a kernel of its own.

Patches are `[m, h, w, c]`; kernels `[m, k, k]` or `[q, k, k]` with an odd k, centred on the pixel
they make. What lies outside a patch is zero. A kernel is laid on as it is, not turned around
(correlation); sets of kernels that are closed under half turns do not notice.
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor


def unfold(patches: Float[Tensor, "m h w c"], size: int) -> Float[Tensor, "m h w c s"]:
    """The `size` x `size` pixels around each pixel, row after row; s = size^2.

    Args:
        patches: Any.
        size: Odd.
    """
    m, h, w, c = patches.shape
    image = patches.movedim(-1, 1).reshape(m * c, 1, h, w)
    around = torch.nn.functional.unfold(image, size, padding=size // 2)  # [m c, s, h w]
    return around.view(m, c, size * size, h, w).permute(0, 3, 4, 1, 2)


def convolve(
    patches: Float[Tensor, "m h w c"], kernels: Float[Tensor, "m k k"]
) -> Float[Tensor, "m h w c"]:
    """One kernel on each patch."""
    around = unfold(patches, kernels.shape[-1])
    return torch.einsum("mhwcs,ms->mhwc", around, kernels.flatten(1))


def convolve_all(
    patches: Float[Tensor, "m h w c"], kernels: Float[Tensor, "q k k"]
) -> Float[Tensor, "m q h w c"]:
    """Every kernel on every patch."""
    around = unfold(patches, kernels.shape[-1])
    return torch.einsum("mhwcs,qs->mqhwc", around, kernels.flatten(1))


def best_match(
    candidates: Float[Tensor, "m q h w c"], wanted: Float[Tensor, "m h w c"]
) -> Int64[Tensor, "m"]:
    """The candidate of each patch with the least sum of absolute differences; the first of equals.

    Source: Hybrid Neural Rendering (CVPR 2023), section 3.2.
    """
    return (candidates - wanted[:, None]).abs().flatten(2).sum(-1).argmin(-1)
