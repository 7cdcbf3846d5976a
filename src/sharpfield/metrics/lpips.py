"""LPIPS v0.1: distance of two images in the features of a network trained on ImageNet.

The graph is written out here; the weights are the user's to bring, since they come with terms of
their own: the backbone as torchvision publishes it (`alexnet-owt-7be5be79.pth` or
`vgg16-397923af.pth`), and the linear layers of LPIPS v0.1 (`alex.pth` or `vgg.pth`, found in the
packages `lpips` and `torchmetrics`). Files are read as plain tensors; nothing in them is executed.
Their SHA-256 is kept, so that a number can be traced to the weights that gave it.

Source: Zhang, Isola, Efros, Shechtman, Wang, "The unreasonable effectiveness of deep features as
a perceptual metric", CVPR 2018.
"""

import hashlib
import pickle
from dataclasses import dataclass, field
from pathlib import Path
from zipfile import BadZipFile

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from sharpfield.core.errors import OptionError, ShapeError

# Mean and deviation of ImageNet, on images in -1...1.
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
SMALL = 1e-10


@dataclass(frozen=True)
class Convolution:
    """One convolution of a backbone, followed by a ReLU."""

    index: int
    """Its place in torchvision's `features`, which names its weights."""
    channels: int
    size: int = 3
    stride: int = 1
    pool: tuple[int, int] | None = None
    """Size and stride of a max-pooling *before* it."""
    tapped: bool = True
    """Whether its features are compared."""


def _vgg() -> tuple[Convolution, ...]:
    layers: list[Convolution] = []
    index = 0
    for block, (depth, channels) in enumerate([(2, 64), (2, 128), (3, 256), (3, 512), (3, 512)]):
        for i in range(depth):
            pool = (2, 2) if block and i == 0 else None
            layers.append(Convolution(index, channels, pool=pool, tapped=i == depth - 1))
            index += 2
        index += 1  # the pooling that follows
    return tuple(layers)


BACKBONES = {
    "alex": (
        Convolution(0, 64, size=11, stride=4),
        Convolution(3, 192, size=5, pool=(3, 2)),
        Convolution(6, 384, pool=(3, 2)),
        Convolution(8, 256),
        Convolution(10, 256),
    ),
    "vgg": _vgg(),
}
PADDING = {11: 2, 5: 2, 3: 1}


SMALLEST_PX = {"alex": 31, "vgg": 16}
"""Below this the last pooling has nothing left to pool."""


@dataclass(frozen=True)
class Lpips:
    """Perceptual distance of two images, with its weights; 0 for equal images."""

    network: str
    kernels: tuple[tuple[Tensor, Tensor], ...]
    """Weight and bias of each convolution."""
    linear: tuple[Tensor, ...]
    """How much each channel of each tapped layer counts."""
    sha256: dict[str, str] = field(default_factory=dict)
    """Hashes of the weight files, by role."""

    @torch.no_grad()
    def __call__(
        self, predicted: Float[Tensor, "h w c"], truth: Float[Tensor, "h w c"]
    ) -> Float[Tensor, ""]:
        """Distance of two images in 0...1, display domain; grey ones are repeated three times.

        Raises:
            ShapeError: The images are too small for the network.
        """
        smallest = SMALLEST_PX[self.network]
        if min(truth.shape[:2]) < smallest:
            raise ShapeError(
                f"LPIPS ({self.network}) needs images of at least {smallest} px a side",
                got=f"{truth.shape[1]}x{truth.shape[0]}",
                do="leave LPIPS out for such small images",
            )
        predicted, truth = predicted.expand(-1, -1, 3), truth.expand(-1, -1, 3)
        total = predicted.new_zeros(())
        pairs = zip(self._unit_features(predicted), self._unit_features(truth), strict=True)
        for weight, (x, y) in zip(self.linear, pairs, strict=True):
            difference = (x - y).square()  # [c, h', w']
            total = total + (weight[:, None, None] * difference).sum(0).mean()
        return total

    def _unit_features(self, image: Float[Tensor, "h w 3"]) -> list[Float[Tensor, "c y x"]]:
        """Features after each tapped layer, of length one at every position."""
        shift, scale = image.new_tensor(SHIFT), image.new_tensor(SCALE)
        x = ((image * 2 - 1 - shift) / scale).permute(2, 0, 1)[None]
        found = []
        for layer, (weight, bias) in zip(BACKBONES[self.network], self.kernels, strict=True):
            if layer.pool:
                x = functional.max_pool2d(x, *layer.pool)
            padding = PADDING[layer.size]
            x = functional.conv2d(x, weight, bias, stride=layer.stride, padding=padding).relu()
            if layer.tapped:
                found.append((x / (x.norm(dim=1, keepdim=True) + SMALL))[0])
        return found


def load_lpips(backbone: Path, linear: Path, *, network: str = "alex") -> Lpips:
    """LPIPS v0.1 with the published weights.

    Args:
        backbone: torchvision's weights of AlexNet or VGG-16 (.pth, or the same as .safetensors).
        linear: The linear layers that belong to them.
        network: "alex", which papers report, or "vgg".

    Raises:
        OptionError: A file cannot be read as plain tensors, or holds other weights.
    """
    if network not in BACKBONES:
        raise OptionError(
            "unknown backbone of LPIPS", got=network, do=f"use one of {', '.join(BACKBONES)}"
        )
    held, weights = _tensors(backbone), _tensors(linear)
    kernels, entering = [], 3
    for layer in BACKBONES[network]:
        name, shape = f"features.{layer.index}", (layer.channels, entering, layer.size, layer.size)
        weight = _named(held, f"{name}.weight", shape, backbone)
        kernels.append((weight, _named(held, f"{name}.bias", shape[:1], backbone)))
        entering = layer.channels
    tapped = [layer.channels for layer in BACKBONES[network] if layer.tapped]
    return Lpips(
        network=network,
        kernels=tuple(kernels),
        linear=tuple(
            _named(weights, f"lin{i}.model.1.weight", (1, channels, 1, 1), linear).flatten()
            for i, channels in enumerate(tapped)
        ),
        sha256={"backbone": _sha256(backbone), "linear": _sha256(linear)},
    )


def _tensors(path: Path) -> dict[str, Tensor]:
    """Named tensors of a file, and nothing else: no object in it is ever built."""
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        loaded = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise OptionError("no file with the weights of LPIPS", where=path) from None
    except (SafetensorError, pickle.UnpicklingError, RuntimeError, BadZipFile, EOFError) as error:
        raise OptionError(
            "weights of LPIPS cannot be read as plain tensors",
            where=path,
            got=str(error).splitlines()[0],
            do="give torchvision's own .pth file, or the same tensors as .safetensors",
        ) from None
    if not isinstance(loaded, dict):
        raise OptionError(
            "weights of LPIPS must be a table of named tensors",
            where=path,
            got=type(loaded).__name__,
        )
    return loaded


def _named(
    held: dict[str, Tensor], name: str, shape: tuple[int, ...], where: Path
) -> Float[Tensor, "..."]:
    value = held.get(name)
    if value is None or tuple(value.shape) != shape:
        raise OptionError(
            f"weights of LPIPS lack {name} of shape {shape}",
            where=where,
            got="nothing of that name" if value is None else f"shape {tuple(value.shape)}",
            do="check that backbone and linear layers belong to the chosen network",
        )
    return value.float()


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
