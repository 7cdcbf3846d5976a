import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.events import EventStream
from sharpfield.recordings.open import format_of
from sharpfield.recordings.recording import ReaderOptions
from sharpfield.recordings.tables import text
from sharpfield.recordings.tables.text import open_text
from sharpfield.storage.event_writer import exporting_events
from tests.recordings import fuzz
from tests.streams import random_events

DAVIS = (240, 180)


def write(folder: Path, lines: str, name: str = "events.txt") -> Path:
    path = folder / name
    path.write_bytes(lines.encode())
    return path


def rpg_lines(count: int) -> str:
    draw = np.random.default_rng(0)
    t = np.cumsum(draw.integers(0, 2000, count)) / 1e6 + 13.5
    rows = zip(
        t.tolist(), *(draw.integers(0, most, count).tolist() for most in (240, 180, 2)), strict=True
    )
    return "".join(f"{t:.9f} {x} {y} {p}\n" for t, x, y, p in rows)


def zipped(lines: str, *names: str) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names or ("events.txt",):
            archive.writestr(name, lines)
    return packed.getvalue()


def open_davis(path: Path):
    return open_text(path, ReaderOptions(size=DAVIS))


fuzz.register("text", fuzz.Case(lambda: rpg_lines(200).encode(), open_davis, ".txt"))
fuzz.register(
    "text-zip", fuzz.Case(lambda: zipped(rpg_lines(200)), open_davis, ".zip", most_per_byte=200)
)


def listed(events: EventStream) -> list[tuple[int, int, int, int]]:
    return list(
        zip(*(c.tolist() for c in (events.t_us, events.x, events.y, events.p)), strict=True)
    )


@pytest.mark.parametrize("clip", ["boxes", "dynamic", "poster"])
def test_real_clips(clip: str, samples: Path) -> None:
    path = samples / f"ecd_tubrip/{clip}_rotation/events.txt"
    recording = open_davis(path)
    events = recording.load()
    other = np.loadtxt(path)
    assert len(events) == 30_000 and not str(recording.log)
    np.testing.assert_array_equal(events.t_us, np.floor(other[:, 0] * 1e6 + 0.5))
    for ours, theirs in ((events.x, other[:, 1]), (events.y, other[:, 2])):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(events.p > 0, other[:, 3] == 1)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("0.000001 2 3 1", (1, 2, 3, 1)),
        ("1.0000005 2 3 0", (1_000_001, 2, 3, -1)),
        ("1.00000049 2 3 -1", (1_000_000, 2, 3, -1)),
        ("0.6367649989999999 7 85 1", (636_765, 7, 85, 1)),
        ("1.358259599900000000e+01\t1.9e+02 8.200000e+01 1.000000e+00", (13_582_596, 190, 82, 1)),
        ("  +5e-6 , 1,2 ; 1 \r", (5, 1, 2, 1)),
        ("1700000000.123456789012345678 1 2 1", (1_700_000_000_123_457, 1, 2, 1)),
        ("-0.0000015 1 2 1", (-1, 1, 2, 1)),
        ("0.0 1 2 1", (0, 1, 2, 1)),
        ("1e-30 1 2 1", (0, 1, 2, 1)),
    ],
)
def test_numbers(line: str, expected: tuple[int, int, int, int], tmp_path: Path) -> None:
    assert listed(open_davis(write(tmp_path, line)).load()) == [expected]


@pytest.mark.parametrize(
    "line",
    ["0.1 2 3", "0.1 2 3 1 5", "0.1 2 3 2", "0.1 2.5 3 1", "0.1 a 3 1", "1e 2 3 1", "0.1 2 - 1"]
    + ["1e40 2 3 1", "0..1 2 3 1", ". 2 3 1", "nan 2 3 1", "0.1 2 3 0.5"],
)
def test_lines_that_are_no_events_are_counted(line: str, tmp_path: Path) -> None:
    recording = open_davis(write(tmp_path, f"0.1 2 3 1\n{line}\n0.2 3 4 0\n"))
    assert listed(recording.load()) == [(100_000, 2, 3, 1), (200_000, 3, 4, -1)]
    assert str(recording.log) == "1 lines that could not be read"


def test_remarks_of_v2e(tmp_path: Path) -> None:
    lines = "#!events.txt\n# created Thu Dec  3 2020\n# t x y p\n0.5 1 2 0\n\n% more\n0.6 3 4 1"
    recording = open_davis(write(tmp_path, lines))
    assert listed(recording.load()) == [(500_000, 1, 2, -1), (600_000, 3, 4, 1)]
    assert not str(recording.log)


def test_the_first_line_may_be_the_size(tmp_path: Path) -> None:
    recording = open_text(write(tmp_path, "240 180\n0.5 239 179 1\n"))
    assert recording.size == DAVIS and listed(recording.load()) == [(500_000, 239, 179, 1)]


def test_our_own_tables(tmp_path: Path) -> None:
    events = random_events(500)
    with exporting_events(tmp_path / "events.csv", events[:0]) as append:
        append(events)
    found = open_text(tmp_path / "events.csv", ReaderOptions(size=(12, 10))).load()
    assert listed(found) == listed(events)


def test_names_tell_order_and_unit(tmp_path: Path) -> None:
    path = write(tmp_path, "x,y,polarity,timestamp_ns\n1,2,0,1500\n", "events.csv")
    assert listed(open_davis(path).load()) == [(2, 1, 2, -1)]


def test_unit_and_order_may_be_given(tmp_path: Path) -> None:
    path = write(tmp_path, "1 2 1500 0\n")
    found = open_text(path, ReaderOptions(size=DAVIS, unit="ms", columns="xytp")).load()
    assert listed(found) == [(1_500_000, 1, 2, -1)]


def test_archives_hold_one_text(tmp_path: Path) -> None:
    plain = open_davis(write(tmp_path, rpg_lines(300))).load()
    path = tmp_path / "a.zip"
    path.write_bytes(zipped(rpg_lines(300), "events.txt", "imu.txt"))
    assert listed(open_davis(path).load()) == listed(plain)
    path.write_bytes(zipped("", "a.txt", "b.txt"))
    with pytest.raises(CaptureError, match="must hold one text of events"):
        open_davis(path)


def test_an_archive_whose_names_are_damaged(tmp_path: Path) -> None:
    data = bytearray(zipped(rpg_lines(3)))
    data[7], data[30] = 0x08, 0xFF  # the name is UTF-8, it says, and is not
    path = tmp_path / "a.zip"
    path.write_bytes(data)
    with pytest.raises(CaptureError, match="cannot read the archive"):
        open_davis(path)


@pytest.mark.parametrize("block", [13, 64])
def test_blocks_may_be_cut_anywhere(
    block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path, "240 180\n# a\n" + rpg_lines(200))
    whole = listed(open_text(path).load())
    cut = text.read_blocks
    recording = open_text(path)
    monkeypatch.setattr(text, "read_blocks", lambda path: cut(path, 0, block))
    assert len(whole) == 200 and listed(recording.load()) == whole


@pytest.mark.parametrize("name", ["text", "text-zip"])
def test_damaged_files_end_cleanly(name: str, tmp_path: Path) -> None:
    assert fuzz.campaign(name, files=120, folder=tmp_path)["partial"] > 1


@pytest.mark.parametrize(
    ("lines", "options", "message"),
    [
        ("0.1 2 3 1\n", {}, "sensor resolution"),
        ("100 2 3 1\n", {"size": DAVIS}, "unit of its times\n.*\n.*the first is 100"),
        ("0.1 2 3 0\n0.1 2 3 -1\n", {"size": DAVIS}, "three values"),
        ("x y t p\n1 2 0.5 1\n", {"size": DAVIS, "columns": "txyp"}, "not those in the file"),
        ("12 0.2 7 1\n", {"size": DAVIS, "unit": "s"}, "no events of four numbers"),
        ("hello\nworld\n", {"size": DAVIS}, "no events of four numbers"),
        ("0.2 1 1 1\n0.1 1 1 1\n" * 300, {"size": DAVIS}, "not ascending"),
    ],
)
def test_texts_that_do_not_do(lines: str, options: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=message):
        open_text(write(tmp_path, lines), ReaderOptions(**options)).load()


def test_options_that_do_not_do(tmp_path: Path) -> None:
    path = write(tmp_path, "0.1 2 3 1\n")
    with pytest.raises(OptionError, match="e.g. xytp"):
        open_text(path, ReaderOptions(size=DAVIS, columns="xyzt"))
    with pytest.raises(OptionError, match="unknown unit"):
        open_text(path, ReaderOptions(size=DAVIS, unit="h"))


def test_tables_of_prophesee(tmp_path: Path) -> None:
    path = write(tmp_path, "%geometry:64,48\n3,4,1,1000007\n5,6,0,1000009", "cd.csv")
    assert format_of(path) == "text"
    recording = open_text(path, ReaderOptions(unit="us", columns="xypt"))
    assert recording.size == (64, 48)
    assert listed(recording.load()) == [(1000007, 3, 4, 1), (1000009, 5, 6, -1)]
