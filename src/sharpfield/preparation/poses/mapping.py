"""Structure from motion with COLMAP (the package `pycolmap`, extra `sfm`).

Features are matched and verified by two-view geometry, then a *map* of points grows image by image.
For small and noisy images, the contrast threshold of features and the number of inliers are lower
than COLMAP's defaults. If images are not registered, it is run again with an even lower contrast
threshold, and the better map is kept.

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

from sharpfield.captures.layouts.colmap import camera_of
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
"""COLMAP's camera model of each lens that can be estimated."""

MIN_FEATURES = 80
"""With fewer features an image is reported as lacking texture."""
MIN_INLIERS = 15
"""Smallest number of matches that fit the two-view geometry of a pair."""
MIN_POSE_INLIERS = 12
"""Smallest number of points that fit the pose of an image."""
MIN_IMAGES = 3
"""Smallest number of images of a map."""
EXHAUSTIVE = 160
"""Up to so many images all pairs are matched; beyond, each image with its neighbours in time."""
NEIGHBOURS = 20
"""Neighbours in time that each image is then matched with."""

FATAL = 3
"""COLMAP's log level of fatal errors only."""


@dataclass(frozen=True)
class Effort:
    """Sensitivity of one attempt."""

    peak_threshold: float
    """Smallest contrast of a SIFT feature, 0...1."""
    guided: bool = False
    """Match again along epipolar lines (guided matching)."""
    initial_inliers: int = 100
    """Inliers of the image pair that the map starts from."""


EFFORTS = (Effort(0.0067), Effort(0.002, guided=True, initial_inliers=40))
"""Tried in turn while images are not registered."""


@dataclass(frozen=True)
class LensTask:
    """Known and unknown parameters of the camera."""

    camera: Camera
    intrinsics: Intrinsics = "given"
    """`given` keeps the camera, `refine` starts from its focal length, `find` estimates all."""
    lens: Lens = "pinhole"
    """Lens model to estimate; only for `find`."""


@dataclass(frozen=True)
class MatchCounts:
    """Features and matches of each image."""

    features: Int64[np.ndarray, "n"]
    """Number of features."""
    matches: Int64[np.ndarray, "n"]
    """Inliers with the image it shares most with."""
    partners: Int64[np.ndarray, "n"]
    """Number of images it has enough inliers with."""
    planar_pairs: float
    """Share of pairs whose matches are explained by a plane or a pure rotation."""


@dataclass(frozen=True)
class SfmMap:
    """Poses and points of structure from motion, in a world of arbitrary scale."""

    registered: Bool[np.ndarray, "n"]
    poses: Float64[np.ndarray, "n 3 4"]
    """World-from-camera; zeros where not registered."""
    camera: Camera
    points: Float64[np.ndarray, "m 3"]
    point_error_px: Float64[np.ndarray, "m"]
    observations: Int64[np.ndarray, "o 2"]
    """Pairs of image index and point index."""
    error_px: Float64[np.ndarray, "n"]
    """Mean reprojection error of each image; NaN where not registered."""

    @property
    def track_length(self) -> Int64[np.ndarray, "m"]:
        """Number of images that observe each point."""
        return np.bincount(self.observations[:, 1], minlength=len(self.points))


def map_images(
    images: UInt8[np.ndarray, "n h w c"], task: LensTask, *, seed: int = 0
) -> tuple[SfmMap | None, MatchCounts]:
    """Find the poses of images of one camera.

    Args:
        images: Display domain, in the order of time.
        task: Known and unknown parameters of the camera.
        seed: Random seed of RANSAC.

    Returns:
        The map, or None if it could not be initialised; and counts of features and matches.

    Raises:
        MissingExtra: pycolmap is not installed.
        CaptureError: There are too few images.
    """
    colmap = need("pycolmap", extra="sfm", purpose="finding poses")
    if len(images) < MIN_IMAGES:
        raise CaptureError(
            "too few images to find poses from",
            got=f"{len(images)}, at least {MIN_IMAGES} are needed",
        )
    best: tuple[SfmMap | None, MatchCounts] | None = None
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


def _count(made: SfmMap | None) -> int:
    return 0 if made is None else int(made.registered.sum())


@contextmanager
def _quiet(colmap: ModuleType) -> Generator[None, None, None]:
    before = colmap.logging.minloglevel
    colmap.logging.minloglevel = FATAL
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

    def run(self, effort: Effort, folder: Path) -> tuple[SfmMap | None, MatchCounts]:
        folder.mkdir()
        self.colmap.set_random_seed(self.seed)
        database = folder / "database.db"
        self._extract(database, effort)
        self._match(database, effort)
        seen = self._match_counts(database)
        return self._map(database, folder, effort), seen

    def _extract(self, database: Path, effort: Effort) -> None:
        reader = self.colmap.ImageReaderOptions()
        reader.camera_model, parameters = _parameters(self.task)
        reader.camera_params = ",".join(f"{value:.12g}" for value in parameters)
        options = self.colmap.FeatureExtractionOptions()
        options.sift.peak_threshold = effort.peak_threshold
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
        check.min_num_inliers = MIN_INLIERS
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

    def _match_counts(self, database: Path) -> MatchCounts:
        count = len(self.names)
        features, matches = np.zeros(count, np.int64), np.zeros(count, np.int64)
        partners, planar_count, pairs_seen = np.zeros(count, np.int64), 0, 0
        kinds = self.colmap.TwoViewGeometryConfiguration
        planar = (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC)
        with self.colmap.Database.open(database) as held:
            row = {image.image_id: int(image.name[:6]) for image in held.read_all_images()}
            for number, i in row.items():
                features[i] = held.num_keypoints_for_image(number)
            for pair, view in zip(*held.read_two_view_geometries(), strict=True):
                agree = len(view.inlier_matches)
                if agree < MIN_INLIERS:
                    continue
                both = [row[number] for number in self.colmap.pair_id_to_image_pair(pair)]
                matches[both] = np.maximum(matches[both], agree)
                partners[both] += 1
                pairs_seen, planar_count = pairs_seen + 1, planar_count + (view.config in planar)
        return MatchCounts(features, matches, partners, planar_count / max(pairs_seen, 1))

    def _map(self, database: Path, folder: Path, effort: Effort) -> SfmMap | None:
        options = self.colmap.IncrementalPipelineOptions()
        options.multiple_models, options.min_model_size = False, MIN_IMAGES
        options.extract_colors, options.random_seed = False, self.seed
        found = self.task.intrinsics != "given"
        options.ba_refine_focal_length = options.ba_refine_extra_params = found
        options.mapper.abs_pose_refine_focal_length = found
        options.mapper.abs_pose_refine_extra_params = found
        options.mapper.abs_pose_min_num_inliers = MIN_POSE_INLIERS
        options.mapper.init_min_num_inliers = effort.initial_inliers
        made = self.colmap.incremental_mapping(
            database, self.folder / "images", folder, options=options
        )
        if not made:
            return None
        largest = max(made.values(), key=lambda one: one.num_reg_images())
        return _as_map(largest, len(self.names), self.task)


def _parameters(task: LensTask) -> tuple[str, list[float]]:
    """COLMAP's camera model, and its known parameters."""
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


def _as_map(made: Any, count: int, task: LensTask) -> SfmMap:
    """The arrays of a reconstruction of COLMAP."""
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
        distances_px = [
            np.linalg.norm(np.asarray(projected) - point.xy)
            for point in points
            if (projected := image.project_point(made.points3D[point.point3D_id].xyz)) is not None
        ]
        error[i] = float(np.mean(distances_px)) if distances_px else np.nan
    inside = [made.points3D[number] for number in row_of]
    camera = task.camera
    if task.intrinsics != "given":
        camera = camera_of(
            held.model.name, held.width, held.height, tuple(held.params), where="the camera found"
        )
    return SfmMap(
        registered=registered,
        poses=poses,
        camera=camera,
        points=np.array([point.xyz for point in inside]).reshape(-1, 3),
        point_error_px=np.array([point.error for point in inside]).reshape(-1),
        observations=np.array(observations, np.int64).reshape(-1, 2),
        error_px=error,
    )
