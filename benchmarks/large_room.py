"""A long walk through a large hall: seconds and memory of every stage of a run.

    python -m benchmarks.large_room --frames 2000 --size 640x480 --points 5000000

Makes a capture in ScanNet's layout, unless it is there from an earlier time: a closed-form hall of
12 m by 9 m, walked around once, with depth of 2 mm noise and some frames blurred. Then `sharpfield
train` runs a few steps, is asked to `--resume` for a few more, and points grow in between. Each
command is a process of its own; seconds are of the CPU. Memory is what the process holds of
its own at the peak; with the pages of mapped files, which the system takes back when it needs them,
it is `with files`. Linux only.
"""

import argparse
import importlib
import json
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.table import Row, save, show
from sharpfield.cli.arguments import parse_size
from sharpfield.core.files import replacing_folder

HALL = np.array([12.0, 3.0, 9.0])
FOCAL = 0.9
"""Over the width of the image."""
TEXEL = 0.004
"""Of the walls, in metres."""
NOISE_M = 0.002
SOFTEST = 9
"""Widest blur, in pixels."""

STAGES = {
    "read": ("sharpfield.captures.read", "read_capture"),
    "judge": ("sharpfield.metrics.quality", "frame_quality"),
    "fuse": ("sharpfield.initialisation.point_cloud", "fuse_points"),
    "fit": ("sharpfield.training.session", "fit"),
    "step": ("sharpfield.training.loop", "accumulate"),
    "grow": ("sharpfield.recipes.points.model", "missing_points"),
    "save": ("sharpfield.training.status", "save_last"),
    "load": ("sharpfield.training.session", "recover"),
}
"""Functions whose times are taken, and where they are looked up."""

RUNS = {"hybrid": ("--preset", "standard"), "room-splat": ("--preset", "standard")}
"""Recipes, and what they are asked for."""

WATCHED_S = 0.1
"""From one look at a process's memory to the next."""

Times = dict[str, list[tuple[float, float]]]
"""When each stage began and ended, in seconds of the CPU since the process began."""


def make(folder: Path, frames: int, size: tuple[int, int]) -> None:
    """Write the capture."""
    place = folder / "exported"
    for name in ("color", "depth", "pose", "intrinsic"):
        (place / name).mkdir(parents=True, exist_ok=True)
    width, height = size
    focal = FOCAL * width
    matrix = np.eye(4)
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] = focal, focal, width / 2, height / 2
    for name in ("color", "depth"):
        np.savetxt(place / "intrinsic" / f"intrinsic_{name}.txt", matrix)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(x - width / 2) / focal, (y - height / 2) / focal, np.ones_like(x)], -1)
    walls = [wallpaper(seed) for seed in range(6)]

    def write(frame: int) -> None:
        pose = walk(frame / frames)
        colour, depth = view(rays.astype(np.float32), pose, walls)
        random = np.random.default_rng(frame)
        if frame % 4:
            wide = int(random.integers(1, SOFTEST + 1))
            colour = cv2.blur(colour, (wide, 1))
        measured = 1000 * (depth + random.normal(0, NOISE_M, depth.shape).astype(np.float32))
        cv2.imwrite(str(place / "color" / f"{frame}.jpg"), colour[..., ::-1])
        cv2.imwrite(
            str(place / "depth" / f"{frame}.png"),
            np.rint(measured).astype(np.uint16),
            [cv2.IMWRITE_PNG_COMPRESSION, 1],
        )
        np.savetxt(place / "pose" / f"{frame}.txt", np.vstack([pose, [0, 0, 0, 1]]))

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(write, range(frames)))


def wallpaper(seed: int) -> np.ndarray:
    """A texture of all sizes that repeats after 4 m, RGB."""
    random, side = np.random.default_rng(seed), round(4.096 / TEXEL)
    pattern = np.zeros((side, side, 3), np.float32)
    for step in (4, 16, 64, 256):
        coarse = random.random((side // step, side // step, 3), np.float32)
        pattern += cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC) / 4
    tint = 0.4 + 0.6 * random.random(3)
    return (255 * tint * pattern.clip(0, 1)).astype(np.uint8)


def walk(part: float) -> np.ndarray:
    """World-from-camera after a part of the way: around, looking outwards and about."""
    turn = 2 * np.pi * part
    place = np.array([4.0 * np.cos(turn), 0.2 * np.sin(9 * turn), 2.7 * np.sin(turn)])
    yaw, pitch = turn + 1.2 * np.sin(13 * turn), 0.5 * np.sin(31 * turn)
    ahead = np.array([np.cos(pitch) * np.cos(yaw), np.sin(pitch), np.cos(pitch) * np.sin(yaw)])
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead, place], -1)


def view(rays: np.ndarray, pose: np.ndarray, walls: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Colour and depth of the hall from inside."""
    ways = rays @ pose[:, :3].T.astype(np.float32)
    here = pose[:, 3].astype(np.float32)
    half = (HALL / 2).astype(np.float32)
    with np.errstate(divide="ignore"):
        away = (np.sign(ways) * half - here) / ways
    axis = np.argmin(np.where(np.isfinite(away), away, np.inf), -1)
    depth = np.take_along_axis(away, axis[..., None], -1)[..., 0]
    texel = np.floor((here + depth[..., None] * ways) / np.float32(TEXEL)).astype(np.int32)
    colour = np.empty((*depth.shape, 3), np.uint8)
    ahead = np.take_along_axis(ways, axis[..., None], -1)[..., 0] > 0
    for number, wall in enumerate(walls):
        chosen = (axis == number // 2) & (ahead == bool(number % 2))
        u, v = (texel[chosen][:, other] for other in range(3) if other != number // 2)
        colour[chosen] = wall[u % len(wall), v % len(wall)]
    return colour, depth


def voxel(points: int) -> float:
    """About so many of them are on the sides of the hall."""
    x, y, z = HALL
    return float(np.sqrt(2 * (x * y + y * z + z * x) / points))


def stages(arguments: list[str], told: Path) -> None:
    """Run the command line here, and write when stages began and ended."""
    times: Times = {name: [] for name in STAGES}
    for name, (module, function) in STAGES.items():
        place = importlib.import_module(module)
        setattr(place, function, watched(getattr(place, function), times[name]))
    from sharpfield.cli.commands import main as command

    try:
        command(arguments)
    finally:
        told.write_text(json.dumps(times))


def watched(function: Callable[..., Any], times: list[tuple[float, float]]) -> Callable[..., Any]:
    """The same function, whose calls are noted."""

    def run(*given: Any, **named: Any) -> Any:
        begun = time.process_time()
        try:
            return function(*given, **named)
        finally:
            times.append((begun, time.process_time()))

    return run


def measured(arguments: list[str], told: Path) -> tuple[Times, float, float]:
    """Stages of a command in a process of its own, and its memory at the peak in GB.

    Returns:
        The stages; what it held of its own; the same with pages of mapped files.
    """
    words = [sys.executable, "-m", "benchmarks.large_room", "--told", str(told), "--", *arguments]
    with subprocess.Popen(words) as process:
        status, own = Path(f"/proc/{process.pid}/status"), 0
        whole = 0
        while process.poll() is None:
            fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
            if "RssAnon" in fields:
                own = max(own, int(fields["RssAnon"].split()[0]))
                whole = max(whole, int(fields["VmHWM"].split()[0]))
            time.sleep(WATCHED_S)
    if process.returncode:
        sys.exit(process.returncode)
    return json.loads(told.read_text()), own / 1e6, whole / 1e6


def row(name: str, times: Times, own: float, whole: float, run: Path) -> Row:
    """A line of the table."""
    (fit, _), *_ = times["fit"]
    spent = {stage: sum(end - begun for begun, end in times[stage]) for stage in STAGES}
    known = spent["read"] + spent["judge"] + spent["fuse"] + spent["load"]
    file = run / "checkpoints" / "last.safetensors"
    return {
        "command": name,
        "read s": spent["read"],
        "judge s": spent["judge"],
        "fuse s": spent["fuse"],
        "other start s": fit - known,
        "load s": spent["load"],
        "step s": statistics.median(end - begun for begun, end in times["step"]),
        "grow s": spent["grow"] / max(len(times["grow"]), 1),
        "save s": spent["save"] / max(len(times["save"]), 1),
        "saved GB": file.stat().st_size / 1e9,
        "GB": own,
        "with files": whole,
    }


def main() -> None:
    """Make the capture, run, print and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--size", default="320x240")
    parser.add_argument("--points", type=int, default=200_000)
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--recipes", nargs="+", choices=RUNS, default=list(RUNS))
    parser.add_argument("--folder", type=Path, default=Path("runs/large_room"))
    parser.add_argument("--told", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("command", nargs="*", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.told is not None:
        stages(asked.command, asked.told)
        return
    source = asked.folder / f"{asked.frames}x{asked.size}"
    if not source.exists():
        begun, (width, height) = time.monotonic(), parse_size(asked.size)
        with replacing_folder(source) as fresh:
            make(fresh, asked.frames, (width, height))
        print(f"made {source} in {time.monotonic() - begun:.0f} s", flush=True)
    rows = []
    for recipe in asked.recipes:
        run = asked.folder / f"{recipe}-{asked.frames}-{asked.points}"
        shutil.rmtree(run, ignore_errors=True)
        common = [recipe, str(source), "--out", str(run), "--hold-out", "every:8", *RUNS[recipe]]
        common += ["--change", *changes(recipe, asked.points)]
        for resume in ([], ["--resume"]):
            steps = asked.steps * (2 if resume else 1)
            words = ["train", *common, "--steps", str(steps), *resume]
            times, own, whole = measured(words, asked.folder / "stages.json")
            rows.append(row(" ".join([recipe, *resume]), times, own, whole, run))
            show(rows[-1:])
    facts = {"frames": asked.frames, "size": asked.size, "points": asked.points}
    print(save("large_room", rows, facts))
    show(rows)


def changes(recipe: str, points: int) -> list[str]:
    """So many points, that grow once before the run is resumed."""
    if recipe == "room-splat":
        return [f"gaussians.cap_max={points}", "gaussians.start=0.9", "gaussians.grow_every=4"]
    return [
        f"cloud.voxel={voxel(points):.5f}",
        "cloud.max_points=0",
        "growth.max_points=0",
        "growth.share=0.0001",
        "growth.every=0.5",
        "growth.until=1",
    ]


if __name__ == "__main__":
    main()
