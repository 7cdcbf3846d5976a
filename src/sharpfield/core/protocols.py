"""What the parts of the house may ask of each other.

Read this first: a `Trajectory` says where a camera is, a `Field` what a scene emits, a
`Renderer` gathers that along rays, a `Formation` turns sharp light into what a sensor reports,
and a `Recipe` builds a `Model` from these on one capture.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, Protocol, TypeVar, runtime_checkable

from jaxtyping import Float, Int64
from torch import Generator, Tensor

from sharpfield.core.measurements import Batch, EventPairs
from sharpfield.core.paper import Paper
from sharpfield.core.points import Growth
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group

if TYPE_CHECKING:
    from sharpfield.core.capture import Capture

M = TypeVar("M", contravariant=True)


@runtime_checkable
class Trajectory(Protocol):
    """Where the camera of each track is, at any time of the capture.

    A track is one camera's path. A hand-held camera has one; photos without a known path are
    one still track each; a rig of event cameras has many.
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
        """First and last time with a known pose; None for a track that stands still."""
        ...


@runtime_checkable
class Head(Protocol):
    """A small network that turns what was looked up at points into density and colour.

    Its parts are asked one after the other, so that a renderer can leave out the later ones, which
    cost most, for points that nobody sees.
    """

    def density(
        self, looked: Float[Tensor, "*b s f"], points: Float[Tensor, "*b s 3"]
    ) -> tuple[Float[Tensor, "*b s"], Float[Tensor, "*b s h"]]:
        """Density before its activation, and what the features are made from."""
        ...

    def feature(self, hidden: Float[Tensor, "*b s h"]) -> Float[Tensor, "*b s f"]:
        """What colour is made from, and what other networks may read of a point."""
        ...

    def colour(
        self, feature: Float[Tensor, "*b s f"], direction: Float[Tensor, "*b 3"]
    ) -> Float[Tensor, "*b s c"]:
        """Linear colour, 0...1, seen along one direction per ray."""
        ...


@runtime_checkable
class Field(Protocol):
    """A sharp scene, asked in two stages: a coarse look, then a fine one where it matters.

    Looking up features is apart from the heads because it is memory-bound and its result small,
    while the heads are compute-bound and their activations large: a renderer may recompute heads
    in the backward pass, chunk by chunk, and keep only what was looked up.
    """

    @property
    def coarse(self) -> Head:
        """Of the first stage."""
        ...

    @property
    def fine(self) -> Head:
        """Of the second stage."""
        ...

    def look(
        self, points: Float[Tensor, "*b s 3"], time: Float[Tensor, "*b"]
    ) -> Float[Tensor, "*b s f"]:
        """Features for the coarse head; `time` belongs to the whole ray."""
        ...

    def look_closer(
        self,
        looked: Float[Tensor, "*b s f"],
        old: Float[Tensor, "*b s 3"],
        new: Float[Tensor, "*b m 3"],
        time: Float[Tensor, "*b"],
    ) -> Float[Tensor, "*b t g"]:
        """Features for the fine head at the old points, then the new ones; t = s + m."""
        ...


@runtime_checkable
class Renderer(Protocol):
    """Light gathered along rays."""

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
    """A recipe built on one capture: all that training, evaluation and viewer may ask of it.

    Every model is also an `nn.Module`.
    """

    capture: "Capture"
    """The capture as the model sees it: in the model's own space."""
    heaviest_step: int
    """The step of the schedule that needs most memory and time."""

    def draw(self, step: int) -> Batch:
        """What step `step` looks at; depends on the step and the seed alone."""
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


@runtime_checkable
class PointSet(Protocol):
    """A module with parameters, or buffers, that have one row for each of its points.

    Every point set is also an `nn.Module`.
    """

    def points(self) -> dict[str, Tensor]:
        """Those parameters and buffers, by their names in the module."""
        ...

    def replace(self, points: Mapping[str, Tensor]) -> None:
        """Take others in their place, with another number of rows; parameters stay parameters."""
        ...


@runtime_checkable
class Growing(Protocol):
    """A model whose points become more, fewer, or others while it learns."""

    def grow(self, step: int) -> Sequence[tuple[PointSet, Growth]]:
        """What becomes of point sets after step `step`; depends on the model, step and seed alone.

        The gradients of the step are still there. What else a model does to itself after a step,
        such as noise on its points, it does here.
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
        """Length of its schedule."""
        ...

    def lasting(self, steps: int) -> "Recipe":
        """The same recipe with its whole schedule stretched or shrunk."""
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
