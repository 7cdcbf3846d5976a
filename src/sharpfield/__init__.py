"""Sharp radiance fields from motion-blurred frames and event-camera streams.

    import sharpfield as sf

    capture = sf.simulate("garden", size=(120, 80), frames=12)   # or sf.read("my_capture")
    run = sf.train("ev-splat", capture, out="runs/garden", minutes=5)
    image = run.render(3)                                        # [h, w, 3], sharp
    run.evaluate()                                               # metrics.json, report.html
    run.export("garden.ply")

The functions are in `sharpfield.api`; what they are made of is in the folders beside it. A sensor
reports a *measurement* of a sharp scene; a *recipe* says which sharp rays explain each
measurement, and how they combine::

    observed = outer( sum_k  w_k * inner( L_k ) )          L_k: sharp light along ray k

Start reading at `core/protocols.py`. Nothing heavy is imported before it is used.
"""

from typing import TYPE_CHECKING

from sharpfield._lazy import lazily

if TYPE_CHECKING:
    from sharpfield import core as core
    from sharpfield import events as events
    from sharpfield import geometry as geometry
    from sharpfield import losses as losses
    from sharpfield import metrics as metrics
    from sharpfield import ops as ops
    from sharpfield import recipes as recipes
    from sharpfield import simulation as simulation
    from sharpfield.api import deblur as deblur
    from sharpfield.api import open_recording as open_recording
    from sharpfield.api import open_run as open_run
    from sharpfield.api import read as read
    from sharpfield.api import simulate as simulate
    from sharpfield.api import train as train
    from sharpfield.api import write as write
    from sharpfield.core.camera import Camera as Camera
    from sharpfield.core.capture import Capture as Capture
    from sharpfield.core.errors import SharpfieldError as SharpfieldError
    from sharpfield.core.events import EventStream as EventStream
    from sharpfield.core.frames import Exposure as Exposure
    from sharpfield.core.frames import Frames as Frames
    from sharpfield.runs.run import Run as Run

__version__ = "0.1.0"

__getattr__, __dir__ = lazily(__name__, __file__)
