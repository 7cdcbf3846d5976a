"""What a run was started with, as JSON beside it: recipe, options, capture, seed.

And what follows from it: which part and which streams of the capture are used, which device.
"""

import dataclasses
import json
import types
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from sharpfield.captures.layout import NO_OPTIONS, ReadOptions
from sharpfield.captures.read import read_capture
from sharpfield.captures.splits import blocks_of, parse_block, restrict_to_block
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError, OptionError, RunError
from sharpfield.core.files import write_json
from sharpfield.recipes import recipe_named

FILE = "recipe.json"
STREAMS = ("frames", "events")

OWN_CAPTURE = "capture"
"""Folder within a run that holds the capture it was trained on, if that existed only in memory."""


@dataclass(frozen=True)
class RunConfig:
    """Everything needed to build a run's model again."""

    name: str
    """Of the recipe."""
    recipe: Any
    """With all its options."""
    capture: str
    """Folder it was trained on; a relative path is one within the run."""
    seed: int
    use: tuple[str, ...] = STREAMS
    """Which streams of the capture are used."""
    reading: ReadOptions = NO_OPTIONS
    """How the capture was read."""
    block: str = ""
    """Which block of a long capture it is trained on, "2/4"; "" for all of it."""

    def settings(self) -> dict[str, Any]:
        """As JSON; the length of the schedule is the run's own."""
        return {
            "recipe": self.name,
            "capture": self.capture,
            "seed": self.seed,
            "use": list(self.use),
            "reading": self.reading.given(),
            **({"block": self.block} if self.block else {}),
            "options": dataclasses.asdict(self.recipe),
        }

    def read_capture(self, run: Path, moved_to: Path | None = None) -> Capture:
        """The capture of a run, or the block of it that the run was trained on.

        Args:
            run: The run's folder.
            moved_to: Where the capture is now; or another one of the same scene and clock.

        Raises:
            CaptureError: It is gone, or cannot be read.
        """
        source = run / self.capture if moved_to is None else moved_to
        if not source.exists():
            raise CaptureError(
                "the capture of this run is gone",
                where=run,
                got=source,
                do="say where it is now: --capture FOLDER, or open_run(..., capture=FOLDER)",
            )
        return block_of(read_capture(source, self.reading), self.block)


def write_run_config(run: Path, config: RunConfig) -> None:
    """Write `RUN/recipe.json`."""
    write_json(run / FILE, config.settings())


def read_run_config(run: Path) -> RunConfig:
    """Read `RUN/recipe.json`.

    Raises:
        RunError: It is missing or damaged, or names an option this version does not know.
    """
    path = run / FILE
    try:
        table = json.loads(path.read_text())
        recipe = from_table(recipe_named(table["recipe"]), table["options"])
        return RunConfig(
            table["recipe"],
            recipe,
            table["capture"],
            int(table["seed"]),
            tuple(table["use"]),
            from_table(ReadOptions, table.get("reading", {})),
            table.get("block", ""),
        )
    except (FileNotFoundError, NotADirectoryError):
        raise RunError(
            "this is not a run", where=run, got=f"no {FILE}", do="name a folder that `train` made"
        ) from None
    except (ValueError, TypeError, KeyError) as error:
        said = error.args[0] if error.args else error
        raise RunError("cannot be read", where=path, got=said, do="train anew") from None


def from_table(kind: type, table: Any) -> Any:
    """A dataclass from nested plain values; unknown keys are errors.

    Raises:
        KeyError: The table names something the dataclass does not have.
        TypeError: It is not a table.
    """
    if not isinstance(table, dict):
        raise TypeError(f"{kind.__name__} needs a table of options, not {table!r}")
    hints = typing.get_type_hints(kind)
    fields = {f.name for f in dataclasses.fields(kind)}
    if unknown := table.keys() - fields:
        raise KeyError(f"{kind.__name__} has no option {', '.join(sorted(unknown))}")
    return kind(**{name: _value(hints[name], value) for name, value in table.items()})


def _value(hint: Any, value: Any) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_table(typing.cast(type, hint), value)
    if isinstance(value, list):
        return tuple(value)
    if typing.get_origin(hint) in (types.UnionType, typing.Union) and isinstance(value, dict):
        kinds = [k for k in typing.get_args(hint) if dataclasses.is_dataclass(k)]
        return from_table(typing.cast(type, kinds[0]), value)
    return value


def device_named(name: str) -> str:
    """`auto` becomes cuda where there is one.

    Raises:
        OptionError: cuda was asked for and is not there, or there is no such kind of device.
    """
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name not in ("cpu", "cuda"):
        raise OptionError("unknown device", got=name, do="use auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise OptionError("there is no CUDA device", do="use the device cpu")
    return name


def used(capture: Capture, streams: tuple[str, ...]) -> Capture:
    """A capture with only some of its streams; without events, if its camera reported none.

    Raises:
        OptionError: A name is unknown.
        CaptureError: Nothing is left.
    """
    if unknown := set(streams) - set(STREAMS):
        raise OptionError("unknown stream", got=", ".join(unknown), do="use frames, events or both")
    missing = {"frames": not capture.frames, "events": not capture.events}
    left = [name for name in streams if not missing[name]]
    if not left:
        raise CaptureError(
            f"the capture has no {' or '.join(streams)}", where=capture.name, do="use what it has"
        )
    return capture.without(frames="frames" not in left, events="events" not in left)


def block_of(capture: Capture, block: str) -> Capture:
    """The block of a capture that "2/4" names; all of it if nothing does."""
    if not block:
        return capture
    index, count = parse_block(block)
    return restrict_to_block(capture, blocks_of(capture, count)[index])
