"""What the parts of the house may ask of each other.

Read this first: a `Trajectory` says where a camera is, a `Field` what a scene emits, a
`Renderer` gathers that along rays, a `Formation` turns sharp light into what a sensor reports,
and a `Recipe` builds a `Model` from these on one capture.
"""

from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar, runtime_checkable

from jaxtyping import Float, Int64
from torch import Generator, Tensor

from sharpfield.core.measurements import Batch
from sharpfield.core.paper import Paper
from sharpfield.core.radiance import Emission, Radiance
from sharpfield.core.rays import Rays
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
        """World-from-camera, OpenCV axes; `time` is 0...1 of the capture, clamped to what is known."""
        ...

    def known_us(self, track: int) -> tuple[int, int] | None:
        """First and last time with a known pose; None for a track that stands still."""
        ...


@runtime_checkable
class Field(Protocol):
    """A sharp scene: the light that points send in a direction at a time."""

    def __call__(
        self,
        points: Float[Tensor, "*b s 3"],
        direction: Float[Tensor, "*b 3"],
        time: Float[Tensor, "*b"],
    ) -> Emission:
        """Emission at `s` points on each ray; direction and time belong to the whole ray."""
        ...


@runtime_checkable
class Renderer(Protocol):
    """Light gathered along rays."""

    def __call__(self, rays: Rays, generator: Generator | None = None) -> Radiance:
        """Radiance of rays; with a generator, samples are jittered and regularised for training."""
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

    def develop(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
        """Linear light as the frames would store it, 0...1."""
        ...

    def groups(self) -> list[Group]:
        """Parameters with their learning rates."""
        ...


@runtime_checkable
class Recipe(Protocol):
    """A paper's numbers (a frozen dataclass), and the one function that builds its model."""

    paper: ClassVar[Paper]

    def build(self, capture: "Capture", seed: int) -> Any:
        """A `Model` on one capture."""
        ...
