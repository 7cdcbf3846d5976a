"""A frame camera and an event camera that look at the same pictures."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from sharpfield.core.capture import Note
from sharpfield.core.events import EventStream
from sharpfield.core.exposure import Exposure
from sharpfield.core.frames import Frames
from sharpfield.core.seed import numpy_generator
from sharpfield.simulation.blur import Exposing, FrameSensor, store
from sharpfield.simulation.event_sensor import EventSensor
from sharpfield.simulation.events import EventPixels, Gap, joined


class Recorder:
    """Blurry frames, their sharp truth, and events, from pictures shown one after the other."""

    def __init__(
        self,
        size: tuple[int, int],
        exposure: Exposure,
        *,
        frame_sensor: FrameSensor,
        event_sensor: EventSensor,
        seed: int,
    ) -> None:
        delay = frame_sensor.row_delay_us
        middle = Exposure(exposure.middle_us, exposure.middle_us)
        self._size, self._seed = size, seed
        self._exposure = replace(exposure, row_delay_us=delay)
        self._blurry = Exposing(exposure, size, row_delay_us=delay)
        self._sharp = Exposing(middle, size, row_delay_us=delay)
        self._frame_sensor, self._event_sensor = frame_sensor, event_sensor
        self._pixels = EventPixels(event_sensor, seed)
        self._gaps: list[Gap] = []

    def see(self, rgb: Float32[np.ndarray, "h w 3"], t_us: int) -> None:
        """Linear light at an instant, after all earlier ones."""
        self._gaps.append(self._pixels.see(rgb, 1000 * t_us))
        self._blurry.see(rgb, t_us)
        self._sharp.see(rgb, t_us)

    def frames(self) -> Frames:
        """All frames, each with the sharp picture at the middle of its exposure as its truth."""
        count, draw = len(self._exposure), numpy_generator(self._seed, 0, "frame noise")
        return Frames(
            images=store(self._blurry.means(), self._frame_sensor, draw),
            exposure=self._exposure,
            track=np.zeros(count, np.int64),
            names=tuple(f"{i:04d}" for i in range(count)),
            encoding=self._frame_sensor.encoding,
            truth=store(self._sharp.means(), self._frame_sensor.noiseless(), draw),
            truth_known=np.ones(count, bool),
        )

    def events(self) -> EventStream:
        """All events."""
        return joined(self._gaps, self._size, bayer=self._event_sensor.bayer)

    def notes(self) -> dict[str, Note]:
        """What a capture should say about its sensors."""
        return {**self._pixels.notes(), "row_delay_us": self._frame_sensor.row_delay_us}
