"""The command line: a command for each verb, errors in words, exit code 2 for what you can mend."""

import sys
from collections.abc import Callable, Sequence

import tyro

from sharpfield.cli.blocks import blocks
from sharpfield.cli.calibrate import calibrate
from sharpfield.cli.captures import deblur, footage, inspect, simulate
from sharpfield.cli.demo import demo
from sharpfield.cli.doctor import doctor
from sharpfield.cli.events import events
from sharpfield.cli.export import export
from sharpfield.cli.ingest import ingest
from sharpfield.cli.poses import poses
from sharpfield.cli.quality import blur, quality
from sharpfield.cli.recipes import recipes
from sharpfield.cli.runs import evaluate, render, train
from sharpfield.core.errors import SharpfieldError

COMMANDS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "simulate": simulate,
    "footage": footage,
    "ingest": ingest,
    "inspect": inspect,
    "deblur": deblur,
    "quality": quality,
    "blur": blur,
    "doctor": doctor,
    "poses": poses,
    "calibrate": calibrate,
    "train": train,
    "blocks": blocks,
    "evaluate": evaluate,
    "render": render,
    "events": events,
    "export": export,
    "recipes": recipes,
}

ABOUT = "Sharp radiance fields from motion-blurred frames and event-camera streams."

INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit: 0 done, 2 the user can mend it, 130 interrupted."""
    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="sharpfield",
            description=ABOUT,
            args=list(sys.argv[1:] if arguments is None else arguments),
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
        )
    except SharpfieldError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    except OSError as error:
        if not error.strerror:
            raise
        said = SharpfieldError(
            error.strerror,
            where=error.filename or "",
            do="check that the path exists, may be read or written, and has room",
        )
        print(said, file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
