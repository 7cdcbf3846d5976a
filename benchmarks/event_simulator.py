"""Events per second of the simulator on one core, against plain numpy, with peak memory.

    python benchmarks/event_simulator.py

Images of a DAVIS346's size at 1000 per second are drawn first and do not count. Each contender
runs in a process of its own, so that peaks do not mix; times are CPU seconds, best of five. Linux
only, for the peak. Counts differ by some 2 %: a flat colour that comes back leaves a pixel exactly
on a threshold, and rounding decides.
"""

import tempfile
import time
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from sharpfield.simulation.cameras.motions import motion
from sharpfield.simulation.scenes.static import scene
from sharpfield.simulation.sensors.event_pixels import LUMA, SENSORS, EventSensor
from sharpfield.simulation.sensors.events import EventPixels
from sharpfield.simulation.static_capture import Rig, view

SIZE, IMAGES, RUNS = (346, 260), 200, 5
MS = 1_000_000


def draw(file: Path) -> None:
    place, path, camera = scene("tiles"), motion("glide", 0), Rig(SIZE).camera()
    poses = path.poses(np.arange(IMAGES, dtype=np.int64) * 1000)
    np.save(file, np.stack([view(place, camera, pose)[0] @ LUMA for pose in poses]))


def plain_numpy(light: np.ndarray, theta: float = 0.2) -> int:
    """An ideal pixel, every gap at once, sorted by numpy: the obvious vectorised program."""
    before = np.log(light[0].ravel() + np.float64(1e-5))
    reference, total = before.copy(), 0
    for k in range(1, len(light)):
        after = np.log(light[k].ravel() + np.float64(1e-5))
        crossed = np.trunc((after - reference) / theta).astype(np.int64)
        hit = np.flatnonzero(crossed)
        count = np.abs(crossed[hit])
        pixel, sign = np.repeat(hit, count), np.repeat(np.sign(crossed[hit]), count)
        nth = np.arange(len(pixel)) - np.repeat(np.cumsum(count) - count, count) + 1
        level = reference[pixel] + theta * sign * nth
        share = (level - before[pixel]) / (after[pixel] - before[pixel])
        t_us = 1000 * (k - 1) + np.rint(1000 * share).astype(np.int64)
        order = np.argsort(t_us, kind="stable")
        x, y = pixel[order] % SIZE[0], pixel[order] // SIZE[0]
        stream = x.astype(np.int16), y.astype(np.int16), t_us[order], sign[order].astype(np.int8)
        total += len(stream[0])
        reference += theta * crossed
        before = after
    return total


def ours(light: np.ndarray, sensor: EventSensor) -> int:
    pixels = EventPixels(sensor, 0)
    return sum(len(pixels.see(image, k * MS).t_us) for k, image in enumerate(light))


def measure(name: str, file: Path) -> tuple[int, float, float]:
    """Events, seconds, and MB of peak memory above what the images and libraries take."""
    light = np.load(file)

    def run() -> int:
        return plain_numpy(light) if name == "numpy" else ours(light, SENSORS[name])

    ours(light[:2], SENSORS["dvs346"])  # compiles
    Path("/proc/self/clear_refs").write_text("5")  # forgets the peak so far
    before, best, events = peak_mb(), np.inf, 0
    for _ in range(RUNS):
        start = time.process_time()
        events = run()
        best = min(best, time.process_time() - start)
    return events, best, peak_mb() - before


def peak_mb() -> float:
    """Most memory that this process has held."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def main() -> None:
    print(f"{IMAGES} images of {SIZE[0]}x{SIZE[1]}, 1 ms apart, threshold 0.2; one core")
    print(f"{'':24}{'events':>10}{'Mev/s':>8}{'images/s':>12}{'peak MB':>9}")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "light.npy"
        draw(file)
        for name, label in (
            ("ideal", "sharpfield, ideal"),
            ("numpy", "numpy, ideal"),
            ("dvs346", "sharpfield, all noise"),
        ):
            with get_context("spawn").Pool(1) as alone:
                events, seconds, peak = alone.apply(measure, (name, file))
            rate, images = 1e-6 * events / seconds, IMAGES / seconds
            print(f"{label:24}{events:10,}{rate:8.1f}{images:12.0f}{peak:9.1f}")


if __name__ == "__main__":
    main()
