"""The command line: a command for each verb, errors in words, exit code 2 for what you can mend.

A command is imported when it is called, so that help and mistakes cost no start-up time.
"""

import os
import sys
import textwrap
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import tyro

from sharpfield import __version__
from sharpfield.cli import recipe_options
from sharpfield.core.errors import Hint, SharpfieldError, expect_one_of


@dataclass(frozen=True)
class Command:
    """A command, before it is imported."""

    function: str
    """`module:name`, the module in `sharpfield.cli`."""
    does: str
    """One line for the list of commands."""
    recipe: bool = False
    """Whether the options of a recipe are options of the command."""
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Old names of options, accepted with a hint."""


GROUPS: dict[str, dict[str, Command]] = {
    "make data": {
        "demo": Command(
            "make_data:demo_command", "record a scene, rebuild it by three methods, compare them"
        ),
        "simulate": Command("make_data:simulate_command", "record a scene with simulated cameras"),
        "footage": Command(
            "make_data:footage_command",
            "make blurry frames and events of sharp images",
            renamed={"per_second": "fps"},
        ),
    },
    "prepare": {
        "ingest": Command(
            "ingest:ingest_command",
            "make a capture of what a camera has recorded",
            renamed={"per_second": "fps", "lonely_ms": "isolated_ms"},
        ),
        "inspect": Command(
            "prepare:inspect_command", "say what a capture, or a file of events, holds"
        ),
        "deblur": Command(
            "prepare:deblur_command", "sharpen frames with their events, without training"
        ),
        "quality": Command("prepare:quality_command", "say which frames of a video are sharp"),
        "blur": Command("prepare:blur_command", "blur sharp images by random motion kernels"),
        "doctor": Command("doctor:doctor_command", "check a capture before training"),
        "poses": Command(
            "poses:poses_command", "find camera poses, or attach those of other programs"
        ),
        "calibrate": Command(
            "prepare:calibrate_command", "measure contrast thresholds, find odd pixels"
        ),
    },
    "learn": {
        "train": Command("learn:train_command", "train a recipe on a capture", recipe=True),
        "blocks": Command("learn:blocks_command", "train a long capture in blocks", recipe=True),
    },
    "look": {
        "evaluate": Command("look:evaluate_command", "measure a run on held-out views"),
        "render": Command(
            "look:render_command",
            "render a video or images along a camera path",
            renamed={"images": "frames", "rate": "fps"},
        ),
        "events": Command(
            "look:events_command", "render the events a camera would report in a scene"
        ),
        "export": Command("look:export_command", "write the Gaussians of a run as a .ply"),
    },
    "tools": {
        "recipes": Command(
            "recipes:recipes_command", "list recipes, describe one, say how to cite it"
        )
    },
}
COMMANDS = {name: one for commands in GROUPS.values() for name, one in commands.items()}

ABOUT = "Sharp radiance fields from motion-blurred frames and event-camera streams."
MENDABLE, INTERRUPTED, CLOSED = 2, 130, 141
"""Exit codes: the user can mend it; interrupted; what reads the output has closed it."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit: 0 done, 2 the user can mend it, 130 interrupted."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", Hint)
            warnings.showwarning = _as_one_line(warnings.showwarning)
            _run(list(sys.argv[1:] if arguments is None else arguments))
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(CLOSED)
    except SharpfieldError as error:
        print(error, file=sys.stderr)
        sys.exit(MENDABLE)
    except OSError as error:
        if not error.strerror:
            raise
        said = SharpfieldError(
            error.strerror,
            where=error.filename or "",
            do="check that the path exists, may be read or written, and has room",
        )
        print(said, file=sys.stderr)
        sys.exit(MENDABLE)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _run(words: list[str]) -> None:
    """Run the command that the first word names.

    Raises:
        OptionError: There is no such command.
    """
    name, *options = words or ["--help"]
    if name in ("-h", "--help"):
        print(usage())
    elif name == "--version":
        print(f"sharpfield {__version__}")
    else:
        expect_one_of("command", name, COMMANDS)
        _call(name, options)


def _call(name: str, words: list[str]) -> None:
    """Run a command with the options that are given in words."""
    prog = f"sharpfield {name}"
    words = recipe_options.renamed(COMMANDS[name].renamed, words)
    config: tuple[Any, ...] = (tyro.conf.FlagCreatePairsOff,)
    if COMMANDS[name].recipe:
        recipe_options.expect_recipe(words)  # before anything heavy is imported
        recipe_options.expect_known(load(name), words)
        if not {"-h", "--help"} & set(words) and not any(w.startswith("-") for w in words[:2]):
            # Mistakes that are none of the recipe's are said before it is imported.
            bare = recipe_options.without_recipe_flags(load(name))
            tyro.cli(bare, prog=prog, args=words, config=config, return_unknown_args=True)
        function, words = recipe_options.with_recipe_flags(load(name), words)
    else:
        function, config = load(name), (*config, tyro.conf.OmitArgPrefixes)
    tyro.cli(function, prog=prog, args=words, config=config)


def load(name: str) -> Callable[..., None]:
    """The function of a command."""
    module, _, function = COMMANDS[name].function.partition(":")
    return getattr(import_module(f"sharpfield.cli.{module}"), function)


def usage() -> str:
    """All commands by what they are for."""
    lines = ["usage: sharpfield COMMAND ...   or   sharpfield --version", "", ABOUT]
    for group, commands in GROUPS.items():
        lines += ["", group, *(f"  {name:<10} {one.does}" for name, one in commands.items())]
    return "\n".join([*lines, "", "`sharpfield COMMAND --help` lists the options of a command."])


def _as_one_line(usual: Callable[..., None]) -> Callable[..., None]:
    """Print hints once, without the place in the code; other warnings as usual."""
    told: set[str] = set()

    def show(message: Any, category: type[Warning], *where: Any) -> None:
        if not issubclass(category, Hint):
            usual(message, category, *where)
        elif (text := textwrap.shorten(f"note: {message}", 400)) not in told:
            told.add(text)
            print(text, file=sys.stderr)

    return show
