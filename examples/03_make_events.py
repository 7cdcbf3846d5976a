"""Record a scene with an event camera and a frame camera behind the same lens.

    python examples/03_make_events.py

writes `events.png`: a blurry frame, the sharp image it should have been, and the events of
its exposure (red: brighter, blue: darker).
"""

import cv2
import numpy as np

from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.static_capture import Rig, Timing, simulate

# Two sensors behind one lens. Thresholds differ a little from pixel to pixel, and a pixel is blind
# for 100 us after an event.
rig = Rig(size=(240, 160), event_sensor=EventSensor(threshold_sigma=0.02, refractory_us=100.0))

# Four exposures of 50 ms. None is held out as a sharp view.
timing = Timing(frames=4, exposure_us=50_000, interval_us=56_000, test_every=0)

capture = simulate("garden", "glide", rig=rig, timing=timing, seed=1)
frames, events = capture.needed_frames, capture.needed_events
print(f"{len(frames)} frames, {len(events):,} events in {capture.clock.span_us / 1000:.0f} ms")

# Events are columns in the order of time; a window of them is a numpy view.
chosen = 2
during = events.window(int(frames.exposure.open_us[chosen]), int(frames.exposure.close_us[chosen]))
change = np.zeros((events.height, events.width))
np.add.at(change, (during.y, during.x), during.p)

strength = np.clip(np.abs(change) / 4, 0, 1)[..., None]
colour = np.where(change[..., None] > 0, [220, 40, 40], [40, 70, 210])
image = np.uint8(255 - strength * (255 - colour))

row = np.hstack([frames.images[chosen], frames.truth[chosen], image])
cv2.imwrite(
    "events.png", cv2.resize(row[..., ::-1], None, fx=2, fy=2, interpolation=cv2.INTER_AREA)
)
print("wrote events.png")
