"""The interfaces between the parts of the package.

Read this first: a `Trajectory` is the pose of a camera over time, a `Field` the density and colour
of a scene, a `Renderer` integrates a field along rays, a `Formation` turns sharp light into what a
sensor reports, and a `Recipe` builds a `Model` from these for one capture.

The publication that a recipe implements, and where the recipe departs from it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int64
from torch import Generator, Tensor

from sharpfield.core.measurements import Batch, EventPairs
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group


@dataclass(frozen=True)
class Paper:
    """A publication behind a recipe."""

    key: str
    """BibTeX key, e.g. `cannici2024evdeblurnerf`."""
    title: str
    bibtex: str
    departures: tuple[str, ...] = ()
    """Each known departure from the published code, in words, with the reason."""


if TYPE_CHECKING:
    from sharpfield.core.capture import Capture

M = TypeVar("M", contravariant=True)


@runtime_checkable
class Trajectory(Protocol):
    """Where the camera of each track is, at any time of the capture.

    A track is one camera's path. A hand-held camera has one; photos without a known path are
    one static track each; a rig of event cameras has many.
    """

    def pose(
        self, time: Float[Tensor, "*b"], track: Int64[Tensor, "*b"]
    ) -> Float[Tensor, "*b 3 4"]:
        """World-from-camera, OpenCV axes.

        Args:
            time: 0...1 of the capture; clamped to the times with a known pose.
            track: Whose camera.
        """
        ...

    def known_us(self, track: int) -> tuple[int, int] | None:
        """First and last time with a known pose; None for a static track."""
        ...


@runtime_checkable
class Head(Protocol):
    """A small network that turns the features at points into density and colour.

    Its parts are called one after the other, so that a renderer can skip the later ones, which cost
    most, for points that contribute no light.
    """

    def density(
        self, features: Float[Tensor, "*b s f"], points: Float[Tensor, "*b s 3"]
    ) -> tuple[Float[Tensor, "*b s"], Float[Tensor, "*b s h"]]:
        """Density before its activation, and the hidden layer."""
        ...

    def feature(self, hidden: Float[Tensor, "*b s h"]) -> Float[Tensor, "*b s f"]:
        """Features from which colour is computed, and which other networks may read."""
        ...

    def colour(
        self, feature: Float[Tensor, "*b s f"], direction: Float[Tensor, "*b 3"]
    ) -> Float[Tensor, "*b s c"]:
        """Linear colour, 0...1, seen along one direction per ray."""
        ...


@runtime_checkable
class Field(Protocol):
    """A sharp scene, evaluated in two stages: coarse samples, then fine ones by importance.

    Feature lookup is separate from the heads because it is memory-bound and its result small, while
    the heads are compute-bound and their activations large: a renderer may recompute heads in the
    backward pass, chunk by chunk, and keep only the features.
    """

    @property
    def coarse(self) -> Head:
        """Of the first stage."""
        ...

    @property
    def fine(self) -> Head:
        """Of the second stage."""
        ...

    def coarse_features(
        self, points: Float[Tensor, "*b s 3"], time: Float[Tensor, "*b"]
    ) -> Float[Tensor, "*b s f"]:
        """Features for the coarse head; `time` belongs to the whole ray."""
        ...

    def fine_features(
        self,
        features: Float[Tensor, "*b s f"],
        old: Float[Tensor, "*b s 3"],
        new: Float[Tensor, "*b m 3"],
        time: Float[Tensor, "*b"],
    ) -> Float[Tensor, "*b t g"]:
        """Features for the fine head at the old points, then the new ones; t = s + m."""
        ...


@runtime_checkable
class Renderer(Protocol):
    """Integrates a field along rays."""

    def __call__(self, rays: Rays, generator: Generator | None = None) -> Radiance:
        """Radiance of rays; with a generator, samples are jittered and noisy, for training."""
        ...


@runtime_checkable
class Formation(Protocol[M]):
    """How a sensor turns sharp light into a measurement."""

    def expose(self, seen: M) -> Rays:
        """The `[b, k]` sharp rays that explain measurements, with their weights."""
        ...

    def observe(self, radiance: Radiance, seen: M) -> Float[Tensor, "b c"]:
        """What the sensor would report, given the light along those rays."""
        ...


@runtime_checkable
class Model(Protocol):
    """A recipe built for one capture: the interface that training and evaluation use.

    Every model is also an `nn.Module`.
    """

    capture: "Capture"
    """The capture in the model's own space."""
    heaviest_step: int
    """The step of the schedule that needs most memory and time."""

    def draw(self, step: int) -> Batch:
        """The batch of a step; depends on the step and the seed only."""
        ...

    def losses(self, batch: Batch, step: int) -> dict[str, Float[Tensor, ""]]:
        """Named terms whose sum is minimised; means over the batch."""
        ...

    def render(self, rays: Rays) -> Radiance:
        """Sharp linear light, without any randomness."""
        ...

    def encode(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
        """Linear light as the frames would store it, 0...1."""
        ...

    def groups(self) -> list[Group]:
        """Parameters with their learning rates."""
        ...


@dataclass(frozen=True)
class Growth:
    """The next set of m points, made from the present one of n: which are kept, copied or new.

    A *point* is an element of a scene with one row in each of several tensors: a Gaussian, a neural
    point. Pruning, cloning, splitting and relocating points are all the same operation.
    """

    source: Int64[Tensor, "m"]
    """The row that each point is a copy of."""
    fresh: Bool[Tensor, "m"]
    """Points whose optimizer state is reset."""
    values: dict[str, Float[Tensor, "m ..."]] = field(default_factory=dict[str, Tensor])
    """Tensors by name that are not just copied; rows equal to their source's stay as they are."""

    def __len__(self) -> int:
        """Number of points afterwards."""
        return len(self.source)


def unchanged(count: int, device: torch.device | str = "cpu") -> Growth:
    """The growth that changes nothing; give it `values` to set some of them."""
    every = torch.arange(count, device=device)
    return Growth(every, torch.zeros_like(every, dtype=torch.bool))


@runtime_checkable
class PointSet(Protocol):
    """A module with parameters, or buffers, that have one row for each of its points.

    Every point set is also an `nn.Module`.
    """

    def points(self) -> dict[str, Tensor]:
        """Those parameters and buffers, by their names in the module."""
        ...

    def replace(self, points: Mapping[str, Tensor]) -> None:
        """Replace them by others, with another number of rows; parameters stay parameters."""
        ...


@runtime_checkable
class Growing(Protocol):
    """A model that adds, removes or replaces points during training."""

    def grow(self, step: int) -> Sequence[tuple[PointSet, Growth]]:
        """Changes of point sets after a step; depends on the model, step and seed only.

        The gradients of the step are still available. Other updates after a step, such as position
        noise, are made here, too.
        """
        ...


@runtime_checkable
class Recipe(Protocol):
    """A paper's numbers (a frozen dataclass), and the one function that builds its model.

    Besides, a recipe may have the class variables `presets` (see `recipes.settings.presets`) and
    `renamed`, which maps old names of its options to new ones.
    """

    paper: ClassVar[Paper]

    @property
    def steps(self) -> int:
        """Number of training steps."""
        ...

    def lasting(self, steps: int) -> "Recipe":
        """The same recipe with its whole schedule rescaled to a number of steps."""
        ...

    def build(self, capture: "Capture", seed: int) -> Model:
        """The model of this recipe on one capture."""
        ...


@runtime_checkable
class Response(Protocol):
    """Linear light to the log of what an event pixel's photoreceptor reports."""

    def __call__(self, light: Float[Tensor, "b k c"], seen: EventPairs) -> Float[Tensor, "b k 1"]:
        """Natural log, one value for each ray."""
        ...
