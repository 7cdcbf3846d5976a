"""Point-NeRF: a sharp scene from neural points, blur and all. The baseline of `hybrid`.

Q. Xu et al., *Point-NeRF: Point-based Neural Radiance Fields*, CVPR 2022. Points from depth carry
learned descriptors; the few around a place on a ray tell its density and colour.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.captures.draw import pixel_table
from sharpfield.captures.draw_patches import PatchShape, draw_patches
from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Batch, Pixels
from sharpfield.core.paper import Paper
from sharpfield.core.radiance import Radiance
from sharpfield.core.rays import Rays
from sharpfield.core.schedule import Group, exponential
from sharpfield.fields.point_networks import ColourHead, PointSizes
from sharpfield.formation.shutter import Pinhole
from sharpfield.formation.tone import tone_of
from sharpfield.losses.points import indecision
from sharpfield.recipes.point_scene import MarchOptions, PointScene
from sharpfield.recipes.point_start import CloudOptions
from sharpfield.rendering.points import Asked, Met

Terms = dict[str, Tensor]

PAPER = Paper(
    key="xu2022pointnerf",
    title="Point-NeRF: Point-based Neural Radiance Fields",
    bibtex="""@inproceedings{xu2022pointnerf,
  title     = {{Point-NeRF}: Point-based Neural Radiance Fields},
  author    = {Xu, Qiangeng and Xu, Zexiang and Philip, Julien and Bi, Sai and Shu, Zhixin and
               Sunkavalli, Kalyan and Neumann, Ulrich},
  booktitle = {IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2022}
}""",
    departures=(
        "Neighbours are the nearest in the window of cells; the released code stops at the first"
        " layer of cells that holds enough, and drops points by chance where a cell is full.",
        "Descriptors start by chance; the released code starts them, and the networks, from"
        " weights trained on another data set for a day.",
        "The regulariser of confidence leaves out empty slots, which the released code fills with"
        " the first point.",
        "Rows of points that a step does not touch are left alone; the released code moves all by"
        " the momentum of Adam.",
        "Steps are uneven by the seed and step, so a run can be repeated.",
    ),
)


@dataclass(frozen=True)
class PointNeRF:
    """Neural points from depth to a scene, blur and all."""

    paper: ClassVar[Paper] = PAPER

    steps: int = 200_000
    """Length of the schedule."""
    rate: float = 5e-4
    """First learning rate of networks."""
    points_rate: float = 2e-3
    """First learning rate of points."""
    decay: float = 0.63
    """What is left of the rates at the end."""
    decisive: float = 1e-4
    """Weight of the term that makes confidences 0 or 1."""
    pixels: int = 3136
    """Drawn per step."""
    frames: int = 1
    """From which the pixels of a step are drawn."""
    border: int = 10
    """Pixels at the edge of frames that are not learned from."""
    start_colours: bool = False
    """The network adds to the colours of the points instead of making its own."""
    cloud: CloudOptions = field(default_factory=CloudOptions)
    sizes: PointSizes = field(default_factory=PointSizes)
    march: MarchOptions = field(default_factory=MarchOptions)

    def lasting(self, steps: int) -> "PointNeRF":
        """The same recipe with its whole schedule stretched or shrunk to `steps`."""
        return replace(self, steps=steps)

    def build(self, capture: Capture, seed: int) -> "Model":
        """The recipe on one capture."""
        return Model(self, capture, seed)


class Model(nn.Module):
    """Neural points and the frames they explain, one ray per pixel."""

    heaviest_step = 0

    def __init__(self, recipe: PointNeRF, capture: Capture, seed: int) -> None:
        super().__init__()
        self.recipe, self.capture, self.seed = recipe, capture, seed
        frames = capture.needed_frames
        self.tone = tone_of(frames.encoding)
        self.table = pixel_table(capture)
        self.scene = PointScene(recipe.cloud, recipe.sizes, recipe.march, capture, seed)
        self.head = ColourHead(recipe.sizes.feature, frames.channels, seed=seed)
        self.pinhole = Pinhole(capture.camera, capture.trajectory)

    def draw(self, step: int) -> Batch:
        """Pixels of a training frame."""
        recipe = self.recipe
        shape = PatchShape(side=1, apart=(1, 1), border=recipe.border)
        drawn = draw_patches(
            self.table, recipe.pixels, shape, frames=recipe.frames, seed=self.seed, step=step
        )
        return {"frames": drawn.to(self.scene.device)}

    def losses(self, batch: Batch, step: int) -> Terms:
        """Error of the pixels whose rays met a point, and indecision of the points."""
        assert isinstance(seen := batch["frames"], Pixels)
        seen = seen.reshape(-1)
        rays = self.pinhole.expose(seen)[:, 0]
        met = self.scene.meet(rays, self.colour, frame=seen.frame, step=step)
        error = (met.colour - seen.value).square().mean(-1) * met.hit
        terms = {"frames": error.sum() / met.hit.sum().clamp_min(1)}
        return terms | self.decided(met)

    def decided(self, met: Met) -> Terms:
        """The term on the confidences of the points that rays met."""
        if self.recipe.decisive == 0:
            return {}
        taken = met.rows[met.rows >= 0].unique()
        sure = self.scene.field.points.take(taken).confidence[:, 0]
        return {"decisive": self.recipe.decisive * indecision(sure)}

    def colour(self, asked: Asked) -> Float[Tensor, "n c"]:
        """Of places on rays."""
        field = self.scene.field
        start = field.mean_colour(asked.rows, asked.way) if self.recipe.start_colours else None
        return self.head(field.feature(asked.hidden, asked.direction), start)

    def render(self, rays: Rays) -> Radiance:
        """Linear light."""
        met = self.scene.meet(rays.reshape(-1), self.colour)
        light = self.tone.decode(met.colour.clamp(0, 1))
        seen = Radiance(light, met.depth, met.opacity, rays.weight.flatten())
        return seen.reshape(*rays.shape)

    def develop(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
        """As the frames store it."""
        return self.tone.encode(light).clamp(0, 1)

    def groups(self) -> list[Group]:
        """Networks and points."""
        recipe = self.recipe

        def falling(rate: float):
            return exponential(rate, recipe.decay * rate, until=max(recipe.steps, 1))

        networks, points = self.scene.groups(falling(recipe.rate), falling(recipe.points_rate))
        head = Group("head", tuple(self.head.parameters()), falling(recipe.rate))
        return [networks, head, points]
