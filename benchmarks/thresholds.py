"""Thresholds that calibration finds, against those that noisy sensors were simulated with.

    python -m benchmarks.thresholds [WORD]

Sixteen captures that differ in scene, motion, sensor, thresholds, dead time, exposure and seed; the
word picks those whose name contains it. All settings were looked at
while the method was made, with other seeds than these.
"""

import sys
import time
from dataclasses import replace
from typing import NamedTuple

from benchmarks.table import Row, save, show
from sharpfield.preparation.calibrate.measure import calibrate
from sharpfield.preparation.options import CalibrateOptions
from sharpfield.simulation.sensors.event_pixels import SENSORS, EventSensor
from sharpfield.simulation.sensors.frames import FrameSensor
from sharpfield.simulation.static_capture import Rig, Timing, simulate

CLEAN, GRAINY = FrameSensor(), FrameSensor(full_well=8000, read_noise=0.003)


class Case(NamedTuple):
    """What is simulated."""

    place: str
    path: str
    sensor: EventSensor
    frame_sensor: FrameSensor
    frames: int
    exposure_ms: int
    interval_ms: int
    size: tuple[int, int] = (128, 96)


def pixel(name: str, darker: float, brighter: float, **changes: float) -> EventSensor:
    """A sensor of `SENSORS` with other thresholds, and what else is to be different."""
    return replace(SENSORS[name], threshold_off=darker, threshold_on=brighter, **changes)


DAVIS, PROPHESEE, HD = "dvs346", "gen3-vga", "gen4-hd"
CASES = {
    "ideal": Case("garden", "glide", pixel("ideal", 0.2, 0.2), CLEAN, 8, 50, 56),
    "davis high": Case("garden", "glide", pixel(DAVIS, 0.36, 0.30), CLEAN, 8, 50, 56),
    "davis low": Case("garden", "shaky", pixel(DAVIS, 0.18, 0.15), CLEAN, 8, 50, 56),
    "gen3 tiles": Case("tiles", "glide", pixel(PROPHESEE, 0.22, 0.22), CLEAN, 8, 50, 56),
    "davis sharp": Case("shelf", "glide", pixel(DAVIS, 0.30, 0.25), CLEAN, 8, 0, 40),
    "davis short": Case("shelf", "shaky", pixel(DAVIS, 0.28, 0.22), GRAINY, 8, 20, 40),
    "dead 350 us": Case(
        *("shelf", "glide", pixel(DAVIS, 0.22, 0.22, refractory_us=350, shot_hz=3)),
        *(GRAINY, 10, 30, 50, (120, 90)),
    ),
    "gen3 long": Case(
        "garden", "shaky", pixel(PROPHESEE, 0.24, 0.16), GRAINY, 8, 60, 66, (144, 96)
    ),
    "slow pixels": Case(
        "tiles", "shaky", pixel(DAVIS, 0.28, 0.28, cutoff_hz=150), GRAINY, 8, 40, 50
    ),
    "gen4 short": Case("garden", "glide", pixel(HD, 0.20, 0.30), GRAINY, 9, 10, 33),
    "gen3 high": Case("shelf", "shaky", pixel(PROPHESEE, 0.35, 0.35), CLEAN, 7, 50, 70, (160, 96)),
    "leaking, sharp": Case(
        "tiles", "glide", pixel(DAVIS, 0.18, 0.18, leak_hz=0.5), GRAINY, 12, 0, 50
    ),
    "davis far apart": Case("garden", "shaky", pixel(DAVIS, 0.30, 0.40), CLEAN, 8, 30, 100),
    "davis lowest": Case("shelf", "glide", pixel(DAVIS, 0.16, 0.12), GRAINY, 8, 50, 56),
    "no dead time": Case(
        *("garden", "glide", pixel(DAVIS, 0.25, 0.25, refractory_us=0, threshold_sigma=0.04)),
        *(GRAINY, 6, 80, 90),
    ),
    "gen3 noisy": Case(
        "tiles", "glide", pixel(PROPHESEE, 0.28, 0.20, shot_hz=2), GRAINY, 8, 40, 45
    ),
}


def measure(name: str, case: Case, seed: int) -> Row:
    """One row: what is true, what is found, and how far off it is."""
    capture = simulate(
        case.place,
        case.path,
        rig=Rig(case.size, case.frame_sensor, case.sensor),
        timing=Timing(case.frames, 1000 * case.exposure_ms, 1000 * case.interval_ms, test_every=0),
        seed=seed,
    )
    began = time.process_time()
    found = calibrate(capture, CalibrateOptions())
    spent = time.process_time() - began
    true = case.sensor
    return {
        "capture": name,
        "scene": f"{case.place}, {case.path}",
        "exposure ms": case.exposure_ms,
        "true": f"{true.threshold_off:.3f} {true.threshold_on:.3f}",
        "found": f"{found.negative:.3f} {found.positive:.3f}",
        "off %": f"{100 * (found.negative / true.threshold_off - 1):+.1f}"
        f" {100 * (found.positive / true.threshold_on - 1):+.1f}",
        "dead us": f"{true.refractory_us:.0f} {found.dead_us:.0f}",
        "cpu s": round(spent, 1),
    }


def main() -> None:
    word = sys.argv[1] if len(sys.argv) > 1 else ""
    rows = [
        measure(name, case, seed) for seed, (name, case) in enumerate(CASES.items()) if word in name
    ]
    show(rows)
    if not word:
        print(save("thresholds", rows, {}))


if __name__ == "__main__":
    main()
