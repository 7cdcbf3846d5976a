"""The model of event camera pixels: thresholds, refractory period, noise, bandwidth, colour.

A pixel makes an event each time the logarithm of its light has changed by a threshold since its
last event. `EventSensor` lists the ways in which real pixels depart from that.

Source: ESIM (Rebecq et al., CoRL 2018) for the ideal pixel; v2e (Hu et al., CVPRW 2021) for leak,
shot noise and bandwidth; Robust e-NeRF (Low and Lee, ICCV 2023) for the reset at the end of the
refractory period; table 1 of Gallego et al., *Event-based vision: a survey* (TPAMI 2022), for
resolution, latency and background rate of sensors that are sold.
"""

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt64

from sharpfield.core.errors import OptionError
from sharpfield.core.seed import numpy_generator

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Rec.601 weights, applied to linear RGB."""
LEAST_THRESHOLD = 0.01
"""Smallest threshold of a pixel, in natural log."""
LIN_LOG_KNEE = 20 / 255
"""Below this intensity the lin-log curve is linear."""
BRIGHT_SHOT = 0.25
"""Shot noise of a fully lit pixel, as a fraction of that in the dark (v2e)."""
DARK_SPEED = 0.1
"""Bandwidth in the dark, as a fraction of that in full light (v2e)."""


@dataclass(frozen=True)
class EventSensor:
    """Parameters of an event camera; the defaults are an ideal one."""

    threshold_on: float = 0.2
    """Mean contrast threshold of ON events, natural log."""
    threshold_off: float = 0.2
    """Mean contrast threshold of OFF events, natural log."""
    threshold_sigma: float = 0.0
    """Standard deviation of the thresholds over the pixels, natural log."""
    refractory_us: float = 0.0
    """Refractory period after an event."""
    refractory_rule: Literal["drop", "reset"] = "drop"
    """In the refractory period, crossings are dropped but move the reference level; or the pixel is
    held in reset, and the reference is the light at its end."""
    leak_hz: float = 0.0
    """ON events per second without any change of light, from leaking junctions."""
    leak_jitter: float = 0.0
    """Standard deviation of leak intervals, as a fraction of their mean."""
    shot_hz: float = 0.0
    """Noise events per second and pixel in the dark; they fall off with light."""
    hot_share: float = 0.0
    """Fraction of pixels that are hot."""
    hot_hz: float = 100.0
    """ON events per second of a hot pixel."""
    cutoff_hz: float = 0.0
    """Bandwidth of a fully lit pixel, a first-order low-pass on the log; lower in the dark. 0 for
    unlimited bandwidth."""
    bayer: str = ""
    """Colour filter tile, e.g. "RGGB"; "" for a mono sensor, which measures Rec.601 luma."""
    curve: Literal["log", "lin-log"] = "log"
    floor: float = 1e-5
    """Added to linear intensity before the logarithm."""
    start: Literal["light", "random"] = "light"
    """Reference level at the first instant: the light itself, or random between the thresholds."""

    def __post_init__(self) -> None:
        if not (self.threshold_on > 0 and self.threshold_off > 0):
            raise OptionError(
                "contrast thresholds must be positive",
                got=f"on {self.threshold_on}, off {self.threshold_off}",
                do="typical sensors have 0.1 to 0.5 in natural log",
            )
        if self.bayer and (len(self.bayer) != 4 or set(self.bayer) - set("RGB")):
            raise OptionError(
                "unknown colour filter tile", got=self.bayer, do='use for example "RGGB", or ""'
            )
        if self.refractory_rule not in ("drop", "reset"):
            raise OptionError(
                "unknown refractory rule", got=self.refractory_rule, do='use "drop" or "reset"'
            )


DVS346 = EventSensor(
    threshold_on=0.22,
    threshold_off=0.22,
    threshold_sigma=0.025,
    refractory_us=200.0,
    refractory_rule="reset",
    leak_hz=0.1,
    leak_jitter=0.3,
    shot_hz=1.0,
    hot_share=2e-4,
    cutoff_hz=400.0,
    start="random",
)
"""A DAVIS346 in moderate light, 346x260 (libcaer, `davis.h`).

v2e's command line (SensorsINI/v2e, `v2e_args.py`) has, for good light, a threshold of 0.2 in
natural log with a spread of 0.03, 300 Hz in full light, a leak of 0.01 Hz, noise of 0.001 Hz and a
dead time of 500 us; its `noisy` pixels have 0.05, 30 Hz, 0.1 Hz, 5 Hz and 10 ms. Ours lie between
the two in leak and noise, and beside the first in the rest. Assumed: the share of hot pixels.
"""

GEN3_VGA = replace(
    DVS346,
    threshold_sigma=0.02,
    refractory_us=100.0,
    leak_hz=0.05,
    shot_hz=0.05,
    hot_share=1e-4,
    cutoff_hz=4000.0,
)
"""Prophesee's third generation, 640x480.

Published: latency 40 to 200 us, taken as the time constant of the low-pass in full light (40 us
are 4 kHz); 0.1 background events per second and pixel, here half of them leak and half shot noise;
the least contrast seen is 12 %. Assumed: an everyday threshold of 25 % (0.22 in natural log), its
spread over the pixels, the dead time, and the share of hot pixels.
"""

GEN4_HD = replace(GEN3_VGA, refractory_us=50.0, cutoff_hz=8000.0)
"""Prophesee's fourth generation, 1280x720 (Finateu et al., ISSCC 2020).

Published: latency 20 to 150 us (20 us are 8 kHz), 0.1 background events per second and pixel, the
least contrast seen 11 %. Assumed: as for `GEN3_VGA`.
"""

SENSORS: dict[str, EventSensor] = {
    "ideal": EventSensor(),
    "dvs346": DVS346,
    "gen3-vga": GEN3_VGA,
    "gen4-hd": GEN4_HD,
}
"""Sensors by name."""

SIZES = {"dvs346": (346, 260), "gen3-vga": (640, 480), "gen4-hd": (1280, 720)}
"""Width and height in px of those that are real."""


class Pixels(NamedTuple):
    """Parameters and state of each pixel; the state is updated by the kernel."""

    on: Float64[np.ndarray, "n"]
    off: Float64[np.ndarray, "n"]
    leak: Float64[np.ndarray, "n"]
    """Log units per ns."""
    reference: Float64[np.ndarray, "n"]
    """Reference level: log light at the last event."""
    ready_ns: Int64[np.ndarray, "n"]
    """End of the refractory period; the smallest integer if there is none."""
    hazard: Float64[np.ndarray, "n"]
    """Rest of an exponential variable; a noise event occurs when it reaches zero."""
    random: UInt64[np.ndarray, "n"]
    """State of each pixel's own generator."""


def make_pixels(sensor: EventSensor, level: Float64[np.ndarray, "n"], seed: int) -> Pixels:
    """Random pixels of a sensor, whose first log light is `level`."""
    n = len(level)
    draw = numpy_generator(seed, 0, "event pixels")
    spread = sensor.threshold_sigma * draw.standard_normal((2, n))
    on = np.maximum(sensor.threshold_on + spread[0], LEAST_THRESHOLD)
    off = np.maximum(sensor.threshold_off + spread[1], LEAST_THRESHOLD)
    hot = draw.random(n) < sensor.hot_share
    leak = on * 1e-9 * (sensor.leak_hz + hot * sensor.hot_hz)
    fraction = draw.random(n)
    reference = level.copy()
    if sensor.start == "random":
        reference += off - fraction * (on + off)
    return Pixels(
        on=on,
        off=off,
        leak=leak,
        reference=reference,
        ready_ns=np.full(n, np.iinfo(np.int64).min),
        hazard=draw.standard_exponential(n),
        random=draw.integers(0, 2**64, n, dtype=np.uint64),
    )


def brightness(
    rgb: Float32[np.ndarray, "h w 3"] | Float32[np.ndarray, "h w"], bayer: str
) -> Float32[np.ndarray, "h w"]:
    """The linear intensity that falls on each pixel: luma, or its filter's own channel."""
    if rgb.ndim == 2:
        return rgb
    if not bayer:
        return rgb @ LUMA
    seen = np.empty(rgb.shape[:2], np.float32)
    for corner, colour in enumerate(bayer):
        row, column = divmod(corner, 2)
        seen[row::2, column::2] = rgb[row::2, column::2, "RGB".index(colour)]
    return seen


def log_intensity(
    light: Float32[np.ndarray, "h w"], sensor: EventSensor
) -> Float64[np.ndarray, "n"]:
    """Output of the photoreceptor: the logarithm, or lin-log, which is linear in the dark."""
    value = light.reshape(-1).astype(np.float64) + sensor.floor
    if sensor.curve == "log":
        return np.log(value)
    straight = np.log(LIN_LOG_KNEE) + value / LIN_LOG_KNEE - 1
    return np.where(value < LIN_LOG_KNEE, straight, np.log(np.maximum(value, LIN_LOG_KNEE)))
