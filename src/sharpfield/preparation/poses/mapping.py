"""Structure from motion: where images were taken from, found from the images alone.

COLMAP does the work (the package `pycolmap`, extra `sfm`): features, matches that fit the geometry
of two views, then a *map* of points that grows image by image. It is told of small and noisy
images: fainter features and fewer agreeing points suffice than by default. Where images are
left out, it is tried again with fainter features still, and the better map is kept.

Source: Schönberger and Frahm, "Structure-from-motion revisited" (CVPR 2016).
"""

import tempfile
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from sharpfield.captures.layouts.colmap_model import camera_of
from sharpfield.core.camera import Camera
from sharpfield.core.errors import CaptureError, need
from sharpfield.core.lenses import LENSES
from sharpfield.preparation.options import Intrinsics, Lens
from sharpfield.storage.images import write_image

FOUND_MODELS = {
    "pinhole": "SIMPLE_PINHOLE",
    "radial": "SIMPLE_RADIAL",
    **{name: LENSES[name].colmap[0].name for name in ("brown", "fisheye")},
}
"""COLMAP's models of the lenses that can be found."""

LEAST_FEATURES = 80
"""Fewer in a image are why it fails."""
LEAST_MATCHES = 15
"""Matches that agree on the geometry of two views, to count as seeing the same."""
LEAST_POINTS = 12
"""Points of the map that must agree on a image's pose."""
LEAST_IMAGES = 3
"""Of a map."""
EXHAUSTIVE = 160
"""Up to so many images all pairs are compared; of more, each with its neighbours in time."""
NEIGHBOURS = 20

QUIET = 3
"""COLMAP's level of messages: only those it dies of."""


@dataclass(frozen=True)
class Effort:
    """How hard to look."""

    faintest: float
    """Contrast of a feature, 0...1."""
    guided: bool = False
    """Match again along the lines that the geometry of two views allows."""
    first_pair: int = 100
    """Agreeing matches of the two images the map begins with."""


EFFORTS = (Effort(0.0067), Effort(0.002, guided=True, first_pair=40))
"""Tried in turn while images are left out."""


@dataclass(frozen=True)
class LensTask:
    """What is known of the lens, and what is to be found."""

    camera: Camera
    intrinsics: Intrinsics = "given"
    """`given` keeps the camera, `refine` starts from its focal length, `find` knows nothing."""
    lens: Lens = "pinhole"
    """What to find; only for `find`."""


@dataclass(frozen=True)
class Seen:
    """What COLMAP saw in each image."""

    features: Int64[np.ndarray, "n"]
    matches: Int64[np.ndarray, "n"]
    """That agree with the image it has most in common with."""
    partners: Int64[np.ndarray, "n"]
    """Images it has something in common with."""
    flat_pairs: float
    """Share of pairs in which a plane, or turning on the spot, explains all matches."""


@dataclass(frozen=True)
class Map:
    """Poses and points, in a world of no particular scale."""

    registered: Bool[np.ndarray, "n"]
    poses: Float64[np.ndarray, "n 3 4"]
    """World-from-camera; zeros where not registered."""
    camera: Camera
    points: Float64[np.ndarray, "m 3"]
    point_error_px: Float64[np.ndarray, "m"]
    observations: Int64[np.ndarray, "o 2"]
    """Which image shows which point."""
    error_px: Float64[np.ndarray, "n"]
    """Mean reprojection error of each image; NaN where not registered."""

    @property
    def track_length(self) -> Int64[np.ndarray, "m"]:
        """How many images show each point."""
        return np.bincount(self.observations[:, 1], minlength=len(self.points))


def map_images(
    images: UInt8[np.ndarray, "n h w c"], task: LensTask, *, seed: int = 0
) -> tuple[Map | None, Seen]:
    """Find where images of one camera were taken from.

    Args:
        images: Display-referred, in the order of time.
        task: About the lens.
        seed: Of what is drawn by chance.

    Returns:
        The map, or None if none could be begun; and what was seen in any case.

    Raises:
        MissingExtra: pycolmap is not installed.
        CaptureError: There are too few images.
    """
    colmap = need("pycolmap", extra="sfm", purpose="finding poses")
    if len(images) < LEAST_IMAGES:
        raise CaptureError(
            "too few images to find poses from",
            got=f"{len(images)}, at least {LEAST_IMAGES} are needed",
        )
    best: tuple[Map | None, Seen] | None = None
    with tempfile.TemporaryDirectory(prefix="sharpfield-poses-") as folder, _quiet(colmap):
        names = [f"{i:06d}.png" for i in range(len(images))]
        (Path(folder) / "images").mkdir()
        for name, image in zip(names, images, strict=True):
            write_image(Path(folder) / "images" / name, image)
        for number, effort in enumerate(EFFORTS):
            work = _Work(colmap, Path(folder), names, task, seed)
            made = work.run(effort, Path(folder) / str(number))
            if best is None or _count(made[0]) > _count(best[0]):
                best = made
            if _count(best[0]) == len(images):
                break
    assert best is not None, "there is at least one effort"
    return best


def _count(made: Map | None) -> int:
    return 0 if made is None else int(made.registered.sum())


@contextmanager
def _quiet(colmap: ModuleType) -> Generator[None, None, None]:
    before = colmap.logging.minloglevel
    colmap.logging.minloglevel = QUIET
    try:
        yield
    finally:
        colmap.logging.minloglevel = before


@dataclass(frozen=True)
class _Work:
    """One run of COLMAP over a folder of images."""

    colmap: ModuleType
    folder: Path
    names: Sequence[str]
    task: LensTask
    seed: int

    def run(self, effort: Effort, place: Path) -> tuple[Map | None, Seen]:
        place.mkdir()
        self.colmap.set_random_seed(self.seed)
        database = place / "database.db"
        self._extract(database, effort)
        self._match(database, effort)
        seen = self._seen(database)
        return self._grow(database, place, effort), seen

    def _extract(self, database: Path, effort: Effort) -> None:
        reader = self.colmap.ImageReaderOptions()
        reader.camera_model, parameters = _parameters(self.task)
        reader.camera_params = ",".join(f"{value:.12g}" for value in parameters)
        options = self.colmap.FeatureExtractionOptions()
        options.sift.peak_threshold = effort.faintest
        self.colmap.extract_features(
            database,
            self.folder / "images",
            list(self.names),
            camera_mode=self.colmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=self.colmap.Device.cpu,
        )

    def _match(self, database: Path, effort: Effort) -> None:
        matching = self.colmap.FeatureMatchingOptions()
        matching.guided_matching = effort.guided
        check = self.colmap.TwoViewGeometryOptions()
        check.min_num_inliers = LEAST_MATCHES
        check.ransac.random_seed = self.seed
        common: dict[str, Any] = {"matching_options": matching, "verification_options": check}
        if len(self.names) <= EXHAUSTIVE:
            self.colmap.match_exhaustive(database, **common, device=self.colmap.Device.cpu)
            return
        near = self.colmap.SequentialPairingOptions()
        near.overlap, near.quadratic_overlap = NEIGHBOURS, True
        self.colmap.match_sequential(
            database, **common, pairing_options=near, device=self.colmap.Device.cpu
        )

    def _seen(self, database: Path) -> Seen:
        count = len(self.names)
        features, matches = np.zeros(count, np.int64), np.zeros(count, np.int64)
        partners, flat, pairs_seen = np.zeros(count, np.int64), 0, 0
        kinds = self.colmap.TwoViewGeometryConfiguration
        planar = (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC)
        with self.colmap.Database.open(database) as held:
            row = {image.image_id: int(image.name[:6]) for image in held.read_all_images()}
            for number, i in row.items():
                features[i] = held.num_keypoints_for_image(number)
            for pair, view in zip(*held.read_two_view_geometries(), strict=True):
                agree = len(view.inlier_matches)
                if agree < LEAST_MATCHES:
                    continue
                both = [row[number] for number in self.colmap.pair_id_to_image_pair(pair)]
                matches[both] = np.maximum(matches[both], agree)
                partners[both] += 1
                pairs_seen, flat = pairs_seen + 1, flat + (view.config in planar)
        return Seen(features, matches, partners, flat / max(pairs_seen, 1))

    def _grow(self, database: Path, place: Path, effort: Effort) -> Map | None:
        options = self.colmap.IncrementalPipelineOptions()
        options.multiple_models, options.min_model_size = False, LEAST_IMAGES
        options.extract_colors, options.random_seed = False, self.seed
        found = self.task.intrinsics != "given"
        options.ba_refine_focal_length = options.ba_refine_extra_params = found
        options.mapper.abs_pose_refine_focal_length = found
        options.mapper.abs_pose_refine_extra_params = found
        options.mapper.abs_pose_min_num_inliers = LEAST_POINTS
        options.mapper.init_min_num_inliers = effort.first_pair
        made = self.colmap.incremental_mapping(
            database, self.folder / "images", place, options=options
        )
        if not made:
            return None
        largest = max(made.values(), key=lambda one: one.num_reg_images())
        return _map(largest, len(self.names), self.task)


def _parameters(task: LensTask) -> tuple[str, list[float]]:
    """COLMAP's camera model, and its parameters as far as they are known."""
    camera = task.camera
    if task.intrinsics == "find":
        return FOUND_MODELS[task.lens], []
    inner = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]
    if camera.lens == "pinhole" and task.intrinsics == "refine":
        return "SIMPLE_PINHOLE", [(camera.fx_px + camera.fy_px) / 2, camera.cx_px, camera.cy_px]
    lens = LENSES[camera.lens]
    given = dict(zip(lens.coefficients, camera.distortion, strict=True))
    needed = {name for name, value in given.items() if value}
    for theirs in lens.colmap:
        bent = theirs.parameters[len(inner) :]
        if theirs.parameters[:2] == ("fx", "fy") and needed <= {*bent}:
            return theirs.name, [*inner, *[given.get(name, 0.0) for name in bent]]
    raise CaptureError("COLMAP has no camera model for the lens", got=camera.lens)


def _map(made: Any, count: int, task: LensTask) -> Map:
    """Our arrays of COLMAP's reconstruction."""
    registered, error = np.zeros(count, bool), np.full(count, np.nan)
    poses, observations = np.zeros((count, 3, 4)), []
    row_of = {number: row for row, number in enumerate(sorted(made.points3D))}
    held = next(iter(made.cameras.values()))
    for image in made.images.values():
        if not image.has_pose:
            continue
        i = int(image.name[:6])
        registered[i] = True
        camera_from_world = image.cam_from_world()
        poses[i] = camera_from_world.inverse().matrix()
        points = [point for point in image.points2D if point.has_point3D()]
        observations += [(i, row_of[point.point3D_id]) for point in points]
        away = [
            np.linalg.norm(np.asarray(place) - point.xy)
            for point in points
            if (place := image.project_point(made.points3D[point.point3D_id].xyz)) is not None
        ]
        error[i] = float(np.mean(away)) if away else np.nan
    inside = [made.points3D[number] for number in row_of]
    camera = task.camera
    if task.intrinsics != "given":
        camera = camera_of(
            held.model.name, held.width, held.height, tuple(held.params), where="the camera found"
        )
    return Map(
        registered=registered,
        poses=poses,
        camera=camera,
        points=np.array([point.xyz for point in inside]).reshape(-1, 3),
        point_error_px=np.array([point.error for point in inside]).reshape(-1),
        observations=np.array(observations, np.int64).reshape(-1, 2),
        error_px=error,
    )
