from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
import torch

from sharpfield.captures.native import layout as native
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Known, Split, Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream, SiteColour
from sharpfield.core.frames import DepthMaps
from sharpfield.geometry.trajectory import BSpline, LearnedKnots, Stamped, Still, Tracks


def differences(a, b, name="capture"):
    """Names of the fields in which two captures differ in value or type."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        same = type(a) is type(b) and a.dtype == b.dtype and np.array_equal(a, b)
        return [] if same else [name]
    if is_dataclass(a) and type(a) is type(b):
        return [
            found
            for field in fields(a)
            for found in differences(getattr(a, field.name), getattr(b, field.name), field.name)
        ]
    if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        return [found for key in a for found in differences(a[key], b[key], f"{name}.{key}")]
    if isinstance(a, torch.nn.Module) and type(a) is type(b):
        one, other = dict(a.named_buffers()), dict(b.named_buffers())
        one |= dict(a.named_parameters())
        other |= dict(b.named_parameters())
        return [key for key in one if not torch.equal(one[key], other[key])]
    return [] if type(a) is type(b) and a == b else [name]


def returned(capture, tmp_path):
    native.write(capture, tmp_path / "capture")
    return native.read(tmp_path / "capture")


def test_a_capture_comes_back_exactly(panning, tmp_path):
    assert differences(returned(panning, tmp_path), panning) == []


def test_a_rolling_shutter_comes_back_exactly(panning, tmp_path):
    exposure = replace(panning.frames.exposure, row_delay_us=0.75)
    rolling = replace(panning, frames=replace(panning.frames, exposure=exposure))
    assert differences(returned(rolling, tmp_path), rolling) == []
    assert "row_delay_us = 0.75" in (tmp_path / "capture" / "capture.toml").read_text()


def still(count):
    poses = np.tile(np.eye(3, 4), (count, 1, 1))
    poses[:, :, 3] = np.random.default_rng(0).normal(size=(count, 3))
    return poses


def variations(panning: Capture) -> dict[str, Capture]:
    frames, events, clock = panning.frames, panning.events, panning.clock
    draw = np.random.default_rng(2)
    known = draw.random(9) < 0.5
    truth = np.where(known[:, None, None, None], 255 - frames.images, 0).astype(np.uint8)
    deep = draw.integers(0, 65536, (9, 10, 12, 1)).astype(np.uint16)
    sites = SiteColour(
        draw.random(7).astype(np.float32), draw.random(7), np.int8([0, 1, 2] * 2 + [0])
    )
    rectified = EventStream(
        (events.x + draw.random(5_000)).astype(np.float32),
        (events.y - draw.random(5_000)).astype(np.float32),
        events.t_us,
        events.p,
        12,
        10,
        site_colour=sites,
    )
    spline = BSpline(torch.from_numpy(still(6)), 0, 100_000, clock)
    torch.nn.init.normal_(spline.twist, generator=torch.Generator().manual_seed(0))
    moving = [panning.trajectory, BSpline(torch.from_numpy(still(4)).float(), 0, 99_999, clock)]
    lens = Camera(12, 10, 11.1, 1 / 3, 6.1, 5.2, "brown", (1e-17, -0.2, 0.1 + 0.2, 4.0, 5.0))
    return {
        "truth of some frames": replace(
            panning, frames=replace(frames, truth=truth, truth_known=known)
        ),
        "16-bit grey": replace(panning, frames=replace(frames, images=deep, encoding="linear")),
        "awkward names": replace(
            panning, frames=replace(frames, names=("a/b", "A", "a", "é", "", ".", "x\n", '"', "b"))
        ),
        "rectified colour events": replace(panning, events=rectified),
        "bayer": replace(panning, events=replace(events, bayer="GRBG")),
        "no events": panning.without(events=True),
        "no frames": replace(panning, frames=None, split=Split(*[np.zeros(0, np.int64)] * 2)),
        "lens": replace(panning, camera=lens),
        "line": replace(
            panning,
            trajectory=Stamped(
                panning.trajectory.times_us, panning.trajectory.poses, clock, "linear"
            ),
        ),
        "still": replace(
            panning, frames=replace(frames, track=np.arange(9)), trajectory=Still(still(9))
        ),
        "spline": replace(panning, trajectory=spline),
        "tracks": replace(
            panning,
            frames=replace(frames, track=np.array([0, 1, 2, 3, 4, 1, 0, 1, 4])),
            trajectory=Tracks(moving, still(3)),
        ),
        "one moving track": replace(panning, trajectory=Tracks(moving[:1], still(0))),
        "points": replace(panning, points=draw.normal(size=(5, 3))),
        "frames in no part and in both": replace(
            panning, split=Split(np.array([1, 3]), np.array([3, 5]))
        ),
        "notes": replace(
            panning,
            notes={
                "lux": 0.1 + 0.2,
                "panning": 5e-324,
                "count": 3,
                "file": np.arange(4, dtype=np.int16).reshape(2, 2),
                "a word.with [dots]": 'quotes " and \\ and \n lines',
            },
        ),
        "what is known": replace(
            panning,
            frames=replace(frames, blur_px=draw.random(9)),
            known=Known(
                poses="estimated",
                motion="unknown",
                bounds="unknown",
                thresholds=Thresholds(0.1 + 0.2, 0.7, "estimated"),
                log_floor=1e-3,
                refractory_us=40.0,
                background="white",
                reference_poses="trajectory",
            ),
        ),
        "names": replace(panning, name='ga"rden', source="simulation"),
        "a rig": replace(
            panning,
            frames=replace(frames, track=np.array([0, 1, 2, 3, 4, 1, 0, 1, 4])),
            trajectory=Tracks(moving, still(3)),
            events=replace(events, track=draw.integers(0, 4, 5_000).astype(np.uint16), tracks=4),
            test_events=replace(events[:70], track=np.full(70, 4, np.uint16), tracks=5),
        ),
        "a rig that saw nothing": replace(
            panning,
            trajectory=Still(still(2)),
            events=replace(events[:0], track=np.zeros(0, np.uint16), tracks=2),
        ),
        "measured depth": replace(
            panning,
            frames=replace(frames, names=("a/b", *"bcdefghi")),
            depth=DepthMaps(deep[:, ::2, ::3, 0].copy(), Camera(4, 5, 3.7, 3.6, 2.0, 2.5), 0.002),
        ),
        "geometry": replace(
            panning,
            frames=replace(
                frames,
                depth=np.where(draw.random((9, 10, 12)) < 0.5, np.inf, 2.5).astype(np.float32),
                flow=draw.normal(size=(9, 10, 12, 2)).astype(np.float32),
            ),
        ),
    }


@pytest.mark.parametrize(
    "kind",
    [
        "truth of some frames",
        "16-bit grey",
        "awkward names",
        "rectified colour events",
        "bayer",
        "no events",
        "no frames",
        "lens",
        "line",
        "still",
        "spline",
        "tracks",
        "one moving track",
        "points",
        "frames in no part and in both",
        "notes",
        "what is known",
        "names",
        "a rig",
        "a rig that saw nothing",
        "geometry",
    ],
)
def test_every_kind_of_capture_comes_back_exactly(panning, tmp_path, kind):
    capture = variations(panning)[kind]
    assert differences(capture, panning), "the variation changes nothing"
    assert differences(returned(capture, tmp_path), capture) == []


def test_an_earlier_capture_is_replaced_whole(panning, tmp_path):
    native.write(replace(panning, points=np.zeros((1, 3))), tmp_path / "capture")
    native.write(panning.without(events=True), tmp_path / "capture")
    found = native.read(tmp_path / "capture")
    assert found.points is None and found.events is None
    assert [path.name for path in tmp_path.iterdir()] == ["capture"]


def test_anything_else_is_not_replaced(panning, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(CaptureError, match="will not replace what is not a capture"):
        native.write(panning, tmp_path)
    with pytest.raises(CaptureError, match="will not replace"):
        native.write(panning, tmp_path / "thesis.tex")
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_a_write_that_fails_leaves_nothing(panning, tmp_path):
    learned = replace(panning, trajectory=LearnedKnots(panning.trajectory, knots=4))
    with pytest.raises(CaptureError, match="cannot be written") as caught:
        native.write(learned, tmp_path / "capture")
    assert "LearnedKnots" in str(caught.value) and "Stamped(" in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_split_out_of_order_cannot_be_kept(panning, tmp_path):
    with pytest.raises(CaptureError, match="ascending order"):
        native.write(replace(panning, split=Split(np.array([3, 1]), np.array([0]))), tmp_path / "c")


# What people write by hand


def edited(panning, tmp_path, old, new):
    native.write(panning, tmp_path / "capture")
    path = tmp_path / "capture" / "capture.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return native.read(tmp_path / "capture")


def test_what_may_be_left_out(panning, tmp_path):
    explicit = ', close_us = 80000, track = 0, use = "train" }'
    found = edited(panning, tmp_path, ", close_us = 80000 }", explicit)
    assert differences(found, panning) == []


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("version = 1", "version = 2", "sharpfield-capture version 2"),
        ("fx_px = 11.0\n", "", "`fx_px` is missing"),
        ("fx_px", "fx_pixels", "unknown key `fx_pixels`"),
        ("near = 0.7", 'near = "close"', "`near` must be a number"),
        ('use = "test"', 'use = "exam"', "write one of train, test, both, none"),
        ('kind = "stamped"', 'kind = "drawn"', "use stamped, still, bspline or tracks"),
        ('name = "01"', 'name = "09"', "image not found"),
        ('name = "01"', 'name = "01", file = "../../01.png"', "outside the capture"),
        ("open_us = 12000", "open_us = 22000", "an exposure ends before it begins"),
        ("close_us = 20000", "close_us = 23000", "frames 1 and 2 overlap in time"),
        ("close_us = 86000", "close_us = 860000", "poses do not cover 1 of 9 exposures"),
        ("span_us = 100000", "span_us = 100", "event times look like ns"),
    ],
)
def test_what_is_written_wrongly(panning, tmp_path, old, new, message):
    with pytest.raises(CaptureError) as caught:
        edited(panning, tmp_path, old, new)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("missing", "message"),
    [("trajectory.npz", "file not found"), ("frames/03.png", "image not found")],
)
def test_a_missing_file_is_named(panning, tmp_path, missing, message):
    native.write(panning, tmp_path)
    (tmp_path / missing).unlink()
    with pytest.raises(CaptureError, match=message) as caught:
        native.read(tmp_path)
    assert missing in str(caught.value)


def test_a_track_without_poses_is_refused(panning, tmp_path):
    native.write(variations(panning)["a rig"], tmp_path)
    path = tmp_path / "capture.toml"
    path.write_text(path.read_text().replace("track = 4", "track = 5"))
    with pytest.raises(CaptureError, match="belongs to a track without poses") as caught:
        native.read(tmp_path)
    assert "tracks 0 to 5, 5 with poses" in str(caught.value)


def test_geometry_of_another_size_is_refused(panning, tmp_path):
    native.write(variations(panning)["geometry"], tmp_path)
    np.save(tmp_path / "truth" / "depth.npy", np.zeros((9, 10, 11), np.float32))
    with pytest.raises(CaptureError, match="depth differs from the frames") as caught:
        native.read(tmp_path)
    assert "(9, 10, 11), expected float32 (9, 10, 12)" in str(caught.value)


def test_events_of_another_tool_may_need_their_unit(panning, tmp_path):
    import h5py

    native.write(panning, tmp_path)
    events = panning.events
    with h5py.File(tmp_path / "events.h5", "w") as file:
        file["x"], file["y"], file["p"] = events.x, events.y, events.p
        file["t"] = events.t_us * 1000
    with pytest.raises(CaptureError, match="does not state the unit"):
        native.read(tmp_path)
    text = (tmp_path / "capture.toml").read_text()
    (tmp_path / "capture.toml").write_text(text + '[events]\nunit = "us"\n')
    with pytest.raises(CaptureError, match="event times look like ns") as caught:
        native.read(tmp_path)
    assert '[events] unit = "ns"' in str(caught.value)
    (tmp_path / "capture.toml").write_text(text + '[events]\nunit = "ns"\n')
    assert differences(native.read(tmp_path), panning) == []


# Poses that nobody knows yet


def test_a_capture_without_poses_is_read_only_by_what_needs_none(panning, tmp_path):
    unposed = replace(
        panning,
        trajectory=Still(np.eye(3, 4)[None]),
        known=Known(poses="unknown"),
        notes={"lux": 3.0},
    )
    native.write(unposed, tmp_path)
    assert differences(native.read_unposed(tmp_path), unposed) == []
    with pytest.raises(CaptureError, match="the poses of the camera are unknown") as caught:
        native.read(tmp_path)
    assert "sharpfield poses" in str(caught.value)
    assert str(tmp_path) in str(caught.value)
