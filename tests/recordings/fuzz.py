"""Damaged copies of sound files, and what reading one of them may end in.

    python -m tests.recordings.fuzz --format evt3 --files 20000 [--seed 0]

A *case* is a small sound file and how to open it. A test module makes its cases known at import,
`fuzz.register("evt3", fuzz.Case(...))`, and spends a small budget on them in a test,
`fuzz.campaign("evt3", files=200, folder=tmp_path)`; the command above spends a larger one. A
failure names the seed, and leaves the damaged file beside the others of its folder.

Reading must end in a `CaptureError`, or in sound events, no more than the bytes can hold.
"""

import argparse
import faulthandler
import importlib
import resource
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import checked
from sharpfield.recordings.recording import Recording

Open = Callable[[Path], Recording]


@dataclass(frozen=True)
class Case:
    """A kind of file to damage."""

    original: Callable[[], bytes]
    """Makes a sound file, of a few kB: damage must have a chance to hit something."""
    open: Open
    suffix: str
    """Of the file's name, with the dot."""
    most_per_byte: float = 12.0
    """How many events a byte may stand for; 12 also covers EVT3, 6 at most."""
    seconds: float = 2.0
    """How long reading one file may take."""
    mebibytes: float = 256.0
    """How much more memory reading may take than reading the sound file took."""


CASES: dict[str, Case] = {}


def register(name: str, case: Case) -> None:
    """Make a case known by name to `campaign` and to the command."""
    CASES[name] = case


def fuzzed(original: bytes, generator: np.random.Generator) -> bytes:
    """A damaged copy: one to three wounds. The same generator gives the same copy."""
    data = np.frombuffer(original, np.uint8).copy()
    for _ in range(int(generator.integers(1, 4))):
        if len(data):
            wound = WOUNDS[int(generator.integers(len(WOUNDS)))]
            data = wound(data, generator)
    return data.tobytes()


def check(open_function: Open, path: Path, *, case: Case | None = None) -> str:
    """Read all that a file may hold, and make sure that the outcome is one of the allowed.

    Returns:
        "refused" (by a CaptureError), "partial" (with counts in `log`) or "whole".

    Raises:
        AssertionError: Events are unsound, or more than the bytes can hold, or it took too long or
            too much memory.
    """
    per_byte, seconds = (case.most_per_byte, case.seconds) if case else (12.0, 2.0)
    most_memory = _peak() + (case.mebibytes if case else 256.0)
    begin = time.process_time()  # others may be using the CPU, too
    outcome = _read(open_function, path, most=int(per_byte * path.stat().st_size) + 1)
    took = time.process_time() - begin
    assert took < seconds, f"took {took:.1f} s"
    assert _peak() < most_memory, f"took {_peak():.0f} MiB"
    return outcome


def campaign(name: str, *, files: int, folder: Path, seed: int = 0) -> Counter[str]:
    """Damage a case many times and check each copy; how often each outcome came.

    A copy that fails stays in `folder` as `failed-<name>-<seed><suffix>`.
    """
    case = CASES[name]
    original = case.original()
    sound = folder / f"sound-{name}{case.suffix}"
    sound.write_bytes(original)
    # Reading for the first time may take long: loops are compiled.
    whole = _read(case.open, sound, most=int(case.most_per_byte * len(original)) + 1)
    assert whole == "whole", f"the sound file of {name} is not sound"
    outcomes: Counter[str] = Counter()
    for number in range(seed, seed + files):
        path = folder / f"damaged-{name}{case.suffix}"
        path.write_bytes(fuzzed(original, np.random.default_rng(number)))
        # Compiled loops cannot be interrupted: whoever hangs ends the process, with a traceback.
        faulthandler.dump_traceback_later(30 * case.seconds, exit=True, file=sys.__stderr__)
        try:
            outcomes[check(case.open, path, case=case)] += 1
        except Exception as error:
            kept = path.replace(folder / f"failed-{name}-{number}{case.suffix}")
            raise AssertionError(f"{name}, seed {number}, {kept}: {error!r:.300}") from error
        finally:
            faulthandler.cancel_dump_traceback_later()
    return outcomes


def _peak() -> float:
    """The most memory that this process has had so far, in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _read(open_function: Open, path: Path, *, most: int) -> str:
    try:
        recording = open_function(path)
        _expect_sound(recording, most=most)
    except CaptureError as error:
        assert error.what and str(path) in str(error), f"no clear message: {error}"
        return "refused"
    return "partial" if str(recording.log) else "whole"


def _expect_sound(recording: Recording, *, most: int) -> None:
    count, before = 0, None
    for chunk in recording.chunks() if recording.events else ():
        checked(chunk, recording.path)
        assert (chunk.width, chunk.height) == recording.size, "the size changed on the way"
        if len(chunk):
            assert before is None or chunk.t_us[0] >= before, "time goes back between chunks"
            before = chunk.t_us[-1]
        count += len(chunk)
        assert count <= most, f"{count} events where {most} fit"
    for frame in recording.frames() if recording.frames else ():
        assert frame.image.ndim in (2, 3) and frame.open_us <= frame.close_us
    if recording.triggers:
        found = recording.triggers()
        assert len(found.t_us) == len(found.edge) == len(found.channel)
        assert len(found.t_us) <= most, "more edges than the file can hold"


def _cut(data: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    return data[: int(generator.integers(len(data)))]


def _flip_bits(data: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    flips = int(2 ** generator.integers(0, 6))
    places = generator.integers(len(data), size=flips)
    np.bitwise_xor.at(data, places, (1 << generator.integers(8, size=flips)).astype(np.uint8))
    return data


def _block(data: np.ndarray, generator: np.random.Generator) -> slice:
    """A piece at random, mostly short."""
    length = int(min(2 ** generator.uniform(0, 12), len(data)))
    begin = int(generator.integers(len(data) - length + 1))
    return slice(begin, begin + length)


def _drop(data: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    return np.delete(data, _block(data, generator))


def _splice(data: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    piece = data[_block(data, generator)]
    return np.insert(data, int(generator.integers(len(data) + 1)), piece)


def _overwrite(data: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    piece = data[_block(data, generator)].copy()
    begin = int(generator.integers(len(data) - len(piece) + 1))
    data[begin : begin + len(piece)] = piece
    return data


def _repeat(data: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    block = _block(data, generator)
    times = int(generator.integers(1, 5))
    return np.insert(data, block.start, np.tile(data[block], times))


def _fill(data: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    data[_block(data, generator)] = generator.choice([0, 0xFF])
    return data


def _scramble(data: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    block = _block(data, generator)
    data[block] = generator.integers(256, size=len(data[block]))
    return data


WOUNDS = (_cut, _flip_bits, _drop, _splice, _overwrite, _repeat, _fill, _scramble)


def main() -> None:
    """Read many damaged files of one kind, or of all."""
    folder = Path(__file__).parent
    for path in sorted(folder.rglob("test_*.py")):
        if "fuzz.register" in path.read_text():
            name = ".".join(path.relative_to(folder).with_suffix("").parts)
            importlib.import_module(f"tests.recordings.{name}")
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--format", choices=sorted(CASES), help="one kind only")
    parser.add_argument("--files", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    for name in [asked.format] if asked.format else sorted(CASES):
        folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
        begin = time.perf_counter()
        outcomes = campaign(name, files=asked.files, folder=folder, seed=asked.seed)
        took = time.perf_counter() - begin
        counts = ", ".join(f"{count} {outcome}" for outcome, count in sorted(outcomes.items()))
        print(f"{name}: {counts}; {took:.0f} s, peak {_peak():.0f} MiB; {folder}", flush=True)


if __name__ == "__main__":
    # Not this copy, which is called __main__: the one that the test modules know.
    importlib.import_module("tests.recordings.fuzz").main()
