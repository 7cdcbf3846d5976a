"""`sharpfield export`: the Gaussians of a run as a file for splat viewers."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from sharpfield.cli.arguments import screen
from sharpfield.core.errors import OptionError

Encoding = Literal["linear", "gamma2.2", "srgb"]


def export_command(
    run: Positional[Path],
    out: Path,
    encoding: Encoding | None = None,
    time: int | None = None,
    sequence: int | None = None,
    capture: Path | None = None,
) -> None:
    """Write the Gaussians of a run as a file for viewers of splats, in the capture's own world.

    Args:
        run: Folder of the run.
        out: File to write, FILE.ply.
        encoding: Encoding of the colours of the Gaussians; by default that of the frames.
        time: Of a moving scene, the instant to export, in us on the capture's clock; by default
            the middle of the capture.
        sequence: Export a moving scene at this many instants from the beginning of the capture to
            its end, as FILE_0000.ply, FILE_0001.ply, and so on.
        capture: Folder of the capture, if it moved.
    """
    from sharpfield.runs.run import expect_splat_file, open_run

    expect_splat_file(out)  # before a run is opened
    if time is not None and sequence is not None:
        raise OptionError("an instant or a sequence", got="--time and --sequence", do="give one")
    opened = open_run(run, capture=capture, device="cpu")
    if sequence is not None:
        files = opened.export_sequence(out, sequence, encoding=encoding)
        screen().print(f"{len(files):,} instants are in {files[0]} to {files[-1].name}")
        return
    count = opened.export(out, encoding=encoding, time=time)
    screen().print(f"{count:,} Gaussians are in {out}")
