"""The Python interface: what `import sharpfield as sf` offers as functions.

Thin: each function says its options by name and calls what the command line calls, too. Their
lists of options are longer than elsewhere, so that `help(sf.train)` shows all there is.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from sharpfield.captures.read import read as read_capture
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.recipes import recipe_named
from sharpfield.recipes.presets import prepared
from sharpfield.runs.config import OWN_CAPTURE, STREAMS, RunConfig, device_named, with_options
from sharpfield.runs.run import Run, open_run
from sharpfield.runs.start import start
from sharpfield.training.plan import Options

__all__ = ["open_run", "read", "train"]


def read(
    path: Path | str,
    *,
    layout: str | None = None,
    event_unit: str | None = None,
    missing: Literal["error", "skip"] | None = None,
    encoding: str | None = None,
    hold_out: str | None = None,
    threshold: float | None = None,
    trust_pickle: bool = False,
) -> Capture:
    """Read a capture from a folder.

    Args:
        path: The folder.
        layout: Of its files, such as "native", "ev-deblur-nerf", "nerfstudio" or "colmap"; by
            default it is recognised.
        event_unit: Unit of the event times (ns, us, ms, s), where it is not what the layout has.
        missing: Whether images that are named but not there are an "error" or to "skip".
        encoding: How stored values relate to light (linear, gamma2.2, srgb), where the layout is
            wrong.
        hold_out: Frames to hold out: every:8, train:5, last:5 or none; by default as the layout
            says.
        threshold: Contrast threshold of the events for both signs, natural log, where it is known
            better.
        trust_pickle: Open pickled files, which may name programs to run; only arrays of numbers
            are built from them, and anything else is refused.

    Raises:
        CaptureError: The capture cannot be read, or its poses are not known yet.
        OptionError: An option does not fit the layout.
    """
    return read_capture(
        path,
        layout=layout,
        event_unit=event_unit,
        missing=missing,
        encoding=encoding,
        hold_out=hold_out,
        threshold=threshold,
        trust_pickle=trust_pickle,
    )


def train(
    recipe: str,
    capture: Capture | Path | str,
    *,
    out: Path | str,
    minutes: float | None = None,
    steps: int | None = None,
    preset: str = "",
    options: Mapping[str, Any] | None = None,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    use: tuple[str, ...] = STREAMS,
    block: str = "",
    resume: bool = False,
    memory_gb: float | None = None,
) -> Run:
    """Train a recipe on a capture.

    A capture that is given by its folder is only referred to. One that is given as an object is
    written to `OUT/capture`, so that the run can be opened later; name the folder of a long one.

    Args:
        recipe: Its name; `list(sf.recipes.RECIPES)` has them.
        capture: A capture, or the folder of one.
        out: Folder of the run.
        minutes: Time for training; the schedule is made to fit into it.
        steps: Length of the schedule, instead of `minutes`; by default what the preset says.
        preset: Named settings, several with commas between them; by default they follow the
            capture and the device.
        options: Single options of the recipe by dotted name, such as `{"sampling.views": 5}`;
            `sharpfield recipes describe RECIPE` lists them.
        seed: Random seed.
        device: Where to train.
        use: Streams of the capture to learn from: frames, events.
        block: Part of a long capture, "2/4" for the second of four.
        resume: Go on with the run in `out`, started with the same options.
        memory_gb: Memory for training, in GiB; None for most of what is free.

    Returns:
        The run, with its trained model.

    Raises:
        OptionError: There is no such recipe, preset or option.
        CaptureError: The capture cannot be read, or lacks what the recipe needs.
        RunError: `out` already holds a run, or a loss is not finite.
    """
    if not isinstance(capture, Capture | Path | str):
        raise OptionError(
            "this is not a capture",
            got=type(capture).__name__,
            do="give the folder of one, or what sf.read or sf.simulate return",
        )
    kind, where = recipe_named(recipe), device_named(device)
    length = Options(steps=steps, minutes=minutes, resume=resume, memory_gb=memory_gb)
    in_memory = isinstance(capture, Capture)
    source = capture if in_memory else read_capture(capture)
    made = prepared(recipe, kind(), preset, capture=source, device=where)
    config = RunConfig(
        recipe,
        with_options(made, options or {}),
        OWN_CAPTURE if in_memory else str(Path(capture).resolve()),
        seed,
        use,
        block=block,
    )
    return start(config, source, Path(out), length, device=where)
