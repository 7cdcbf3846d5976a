"""The command line: a command for each verb, errors in words, exit code 2 for what you can mend."""

import sys
from collections.abc import Callable, Sequence

import tyro

from sharpfield.cli.blocks_command import blocks
from sharpfield.cli.calibrate_command import calibrate
from sharpfield.cli.capture_commands import deblur, footage, inspect, simulate
from sharpfield.cli.demo import demo
from sharpfield.cli.doctor_command import doctor
from sharpfield.cli.event_commands import events
from sharpfield.cli.export_command import export
from sharpfield.cli.ingest_command import ingest
from sharpfield.cli.poses_command import poses
from sharpfield.cli.quality_commands import blur, quality
from sharpfield.cli.recipe_commands import recipes
from sharpfield.cli.run_commands import evaluate, render, train
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
