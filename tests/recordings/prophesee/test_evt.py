from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.events import EventStream
from sharpfield.recordings.open import format_of
from sharpfield.recordings.prophesee.evt import decode_chunks, decode_triggers, open_evt
from sharpfield.recordings.recording import ReaderOptions, ReadLog
from sharpfield.storage.evt_writer import writing_evt
from tests.recordings import fuzz
from tests.streams import random_events

Event = tuple[int, int, int, int]
"""x, y, t, p as the decoders should give them."""

HD = (1280, 720)


def evt3_header(size: tuple[int, int] = HD) -> bytes:
    return (
        f"% date 2023-03-29 16:37:46\n% evt 3.0\n% format EVT3;height={size[1]};width={size[0]}\n"
        f"% geometry {size[0]}x{size[1]}\n% plugin_name hal_plugin_imx636_evk4\n% end\n"
    ).encode()


def y3(row: int) -> int:
    return row


def x3(column: int, bright: int) -> int:
    return 0x2000 | bright << 11 | column


def base3(column: int, bright: int) -> int:
    return 0x3000 | bright << 11 | column


def low3(t: int) -> int:
    return 0x6000 | t & 0xFFF


def high3(t: int) -> int:
    return 0x8000 | t >> 12 & 0xFFF


def evt3(*words: int) -> bytes:
    return np.array(words, "<u2").tobytes()


def evt2(*words: int) -> bytes:
    return np.array(words, "<u4").tobytes()


def high2(t: int) -> int:
    return 0x8 << 28 | t >> 6 & 0xFFFFFFF


def cd2(x: int, y: int, t: int, bright: int) -> int:
    return bright << 28 | (t & 0x3F) << 22 | x << 11 | y


def high21(t: int) -> int:
    return high2(t) << 32


def vector21(x: int, y: int, t: int, bright: int, mask: int) -> int:
    return cd2(x, y, t, bright) << 32 | mask


def evt21(*words: int, legacy: bool = False) -> bytes:
    if legacy:
        words = tuple(word >> 32 | (word & 0xFFFFFFFF) << 32 for word in words)
    return np.array(words, "<u8").tobytes()


def listed(events: EventStream) -> list[Event]:
    return list(
        zip(*(c.tolist() for c in (events.x, events.y, events.t_us, events.p)), strict=True)
    )


def decode(
    encoding: str, data: bytes, *, block: int = 2**20, size: tuple[int, int] = HD
) -> tuple[list[Event], str]:
    log = ReadLog()
    cut = [data[i : i + block] for i in range(0, len(data), block)]
    found = decode_chunks(encoding, cut, size, where="test", log=log)
    return [event for part in found for event in listed(part)], str(log)


def write(folder: Path, header: str | bytes, data: bytes = b"") -> Path:
    path = folder / "recording.raw"
    path.write_bytes((header if isinstance(header, bytes) else header.encode()) + data)
    return path


def random_evt3(words: int, seed: int = 0) -> bytes:
    """Words as a camera sends them, for fuzzing and cutting."""
    draw = np.random.default_rng(seed)
    t, out = 3 * 4096 - 500, []
    for _ in range(words // 8):
        before, t = t, t + int(draw.integers(0, 60))
        if not out or before >> 12 != t >> 12 or draw.random() < 0.1:
            out.append(high3(t))
        out += [low3(t), y3(int(draw.integers(720)))]
        out += [x3(int(c), int(draw.integers(2))) for c in draw.integers(0, 1280, 2)]
        if draw.random() < 0.5:
            out.append(base3(32 * int(draw.integers(40)), int(draw.integers(2))))
            masks = draw.integers(0, 4096, 2)
            out += [0x4000 | int(m) for m in masks] + [0x5000 | int(draw.integers(256))]
        if draw.random() < 0.05:
            out += [0xA000 | int(draw.integers(2)), 0xE014, 0xF123, 0xF001, 0x7002]
    return evt3(*out)


def random_evt2(events: int, seed: int = 0) -> bytes:
    draw = np.random.default_rng(seed)
    t, out = 1_000_000, [high2(1_000_000)]
    for _ in range(events):
        before, t = t, t + int(draw.integers(0, 9))
        out += [high2(t)] if before >> 6 != t >> 6 else []
        out.append(cd2(int(draw.integers(640)), int(draw.integers(480)), t, int(draw.integers(2))))
    return evt2(*out)


def random_evt21(words: int, seed: int = 0) -> bytes:
    draw = np.random.default_rng(seed)
    t, out = 1_000_000, [high21(1_000_000)]
    for _ in range(words):
        before, t = t, t + int(draw.integers(0, 30))
        out += [high21(t)] if before >> 6 != t >> 6 else []
        x, y, mask = 32 * draw.integers(10), draw.integers(320), draw.integers(1, 2**32)
        out.append(vector21(int(x), int(y), t, int(draw.integers(2)), int(mask)))
    return evt21(*out)


EVT2_HEADER = b"% plugin_name hal_plugin_gen31_fx3\n% evt 2.0\n"
EVT21_HEADER = b"% format EVT21;width=320;height=320;endianness=little\n% end\n"
fuzz.register("evt2", fuzz.Case(lambda: EVT2_HEADER + random_evt2(500), open_evt, ".raw"))
fuzz.register("evt2.1", fuzz.Case(lambda: EVT21_HEADER + random_evt21(200), open_evt, ".raw"))
fuzz.register("evt3", fuzz.Case(lambda: evt3_header() + random_evt3(1500), open_evt, ".raw"))


# Laws


@pytest.mark.parametrize(
    ("encoding", "data"),
    [("evt2", random_evt2(400)), ("evt2.1", random_evt21(200)), ("evt3", random_evt3(2000))],
)
@pytest.mark.parametrize("block", [1, 7, 64])
def test_blocks_may_be_cut_anywhere(encoding: str, data: bytes, block: int) -> None:
    whole, _ = decode(encoding, data)
    assert len(whole) > 300
    assert decode(encoding, data, block=block)[0] == whole


def test_both_orders_of_halves_give_the_same() -> None:
    words = np.frombuffer(random_evt21(200), "<u8").tolist()
    assert decode("evt2.1", evt21(*words)) == decode("evt2.1-legacy", evt21(*words, legacy=True))


@pytest.mark.parametrize("encoding", ["evt2", "evt3"])
def test_many_chunks_make_the_whole(encoding: str, tmp_path: Path) -> None:
    """More events than are decoded at once, with times among them."""
    events = random_events(2_500_000, last_us=8_000_000)
    with writing_evt(tmp_path / "a.raw", events[:0], encoding=encoding) as writer:
        writer.append(events)
    first = 0
    for part in open_evt(tmp_path / "a.raw").chunks():
        expected = events[first : first + len(part)]
        for name in ("x", "y", "t_us", "p"):
            np.testing.assert_array_equal(getattr(part, name), getattr(expected, name))
        first += len(part)
    assert first == len(events)


@pytest.mark.parametrize("name", ["evt2", "evt2.1", "evt3"])
def test_damaged_files_end_cleanly(name: str, tmp_path: Path) -> None:
    outcomes = fuzz.campaign(name, files=120, folder=tmp_path)
    assert outcomes["partial"] > 10


# Words, one by one


def test_evt2_words() -> None:
    t = 5 * 64 + 63
    edge = 0xA << 28 | 7 << 22 | 3 << 8 | 1
    data = evt2(
        high2(t), cd2(639, 479, t, 1), cd2(0, 0, t, 0), edge, 0xE0000001, 0xF1234567, high2(t + 1)
    ) + evt2(cd2(5, 6, t + 1, 1))
    assert decode("evt2", data) == ([(639, 479, t, 1), (0, 0, t, -1), (5, 6, t + 1, 1)], "")
    found = decode_triggers("evt2", [data], where="test")
    assert (found.t_us.tolist(), found.edge.tolist(), found.channel.tolist()) == ([327], [1], [3])


def test_evt21_words() -> None:
    t = 64 * 99 + 5
    edge = (0xA << 28 | 5 << 22 | 1 << 8) << 32
    data = evt21(
        high21(t),
        vector21(32, 7, t, 1, 1 | 1 << 13 | 1 << 31),
        edge,
        vector21(64, 8, t, 0, 1 << 30),
    )
    events = [(32, 7, t, 1), (45, 7, t, 1), (63, 7, t, 1), (94, 8, t, -1)]
    assert decode("evt2.1", data) == (events, "")
    found = decode_triggers("evt2.1", [data], where="test")
    assert (found.t_us.tolist(), found.edge.tolist(), found.channel.tolist()) == ([t], [-1], [1])


def test_evt3_words() -> None:
    t = 3 * 4096 + 17
    words = [high3(t), low3(t), y3(5), x3(9, 1), x3(8, 0), base3(100, 1), 0x4801, 0x4001, 0x5080]
    words += [0xA001 | 2 << 8, 0xE014, 0xF001, 0xF001, 0x7001, y3(6), x3(1279, 1)]
    events = [(9, 5, t, 1), (8, 5, t, -1), (100, 5, t, 1), (111, 5, t, 1), (112, 5, t, 1)]
    events += [(131, 5, t, 1), (1279, 6, t, 1)]
    assert decode("evt3", evt3(*words)) == (events, "")
    found = decode_triggers("evt3", [evt3(*words)], where="test")
    assert (found.t_us.tolist(), found.edge.tolist(), found.channel.tolist()) == ([t], [1], [2])


def test_a_vector_ends_at_its_eighth_and_twelfth_bit() -> None:
    words = [high3(0), low3(3), y3(1), base3(0, 0), 0x4FFF, 0x5FFF, 0x5001]
    events, _ = decode("evt3", evt3(*words))
    assert [event[0] for event in events] == [*range(20), 20]


def test_rows_of_the_second_camera_count_and_those_of_exposure_do_not() -> None:
    words = [high3(0), low3(3), y3(1) | 0x800, x3(4, 1), 0x1000 | 2, x3(5, 1), base3(6, 1), 0x4001]
    words += [y3(3), x3(7, 1)]
    assert decode("evt3", evt3(*words)) == ([(4, 1, 3, 1), (7, 3, 3, 1)], "")


# Time


def test_a_new_high_time_clears_the_low_one_and_a_repeated_one_does_not() -> None:
    words = [high3(4096), low3(4000), y3(0), x3(1, 1), high3(4096), x3(2, 1), high3(8192), x3(3, 1)]
    words += [low3(2), x3(4, 1)]
    events, log = decode("evt3", evt3(*words))
    assert [event[2] for event in events] == [8096, 8096, 8192, 8194] and not log


def test_a_low_time_that_decreases_is_no_overflow() -> None:
    """Counting 4096 us for each makes 54 ms of the 9 ms of a real sample."""
    words = [high3(4096), low3(100), y3(0), x3(1, 1), low3(95), x3(2, 1), low3(103), x3(3, 1)]
    events, log = decode("evt3", evt3(*words))
    assert events == [(2, 0, 4191, 1), (1, 0, 4196, 1), (3, 0, 4199, 1)] and not log


@pytest.mark.parametrize("step", [1, 2000])
def test_high_times_wrap(step: int) -> None:
    words, expected, high = [], [], 3000
    for i in range(6000 // step * 2):
        words += [0x8000 | high % 4096, low3(5), y3(0), x3(i % 1000, 1)]
        expected.append(high * 4096 + 5)
        high += step
    events, log = decode("evt3", evt3(*words))
    assert [event[2] for event in events] == expected and not log


def test_a_wrap_that_hesitates_counts_once() -> None:
    highs = [4094, 4095, 0, 4095, 0, 1]
    words = [word for high in highs for word in (0x8000 | high, low3(0), y3(0), x3(1, 1))]
    events, _ = decode("evt3", evt3(*words))
    assert [event[2] // 4096 for event in events] == sorted([4094, 4095, 4096, 4095, 4096, 4097])


def test_evt2_times_wrap_after_four_hours() -> None:
    t = (1 << 34) - 10
    data = evt2(*[w for k in range(0, 64, 8) for w in (high2(t + k), cd2(1, 1, t + k, 1))])
    events, log = decode("evt2", data)
    assert [event[2] for event in events] == [t + k for k in range(0, 64, 8)] and not log


@pytest.mark.parametrize("block", [3, 2**20])
@pytest.mark.parametrize("wrong", [1200, 3300, 99])
def test_a_high_time_that_nothing_confirms_is_refused(block: int, wrong: int) -> None:
    """A single wrong bit must not shift all that follows by a wrap of 17 s."""
    words = []
    for high in (1000, 1001, wrong, 1002, 1003):
        words += [0x8000 | high, low3(7), y3(0), x3(1, 1)]
    events, log = decode("evt3", evt3(*words), block=block)
    highs = [event[2] // 4096 for event in events]
    assert highs == [1000, 1001, 1001, 1002, 1003]
    assert log == "1 times out of line with those before and after"


def test_events_before_any_time_are_left_out() -> None:
    data = evt3(y3(1), x3(1, 1), base3(0, 1), 0x4007, high3(4096), x3(2, 0))
    assert decode("evt3", data) == ([(2, 1, 4096, -1)], "4 events before the first time")


# Files


def test_real_evt2(samples: Path) -> None:
    recording = open_evt(samples / "prophesee/evt2_sample.raw")
    events = recording.load()
    assert (recording.layout, recording.size) == ("EVT2", (640, 480))
    assert len(events) == 539_481
    assert (events.t_us[0], events.t_us[-1]) == (1_317_888, 1_367_888)
    assert (events.x.max(), events.y.max()) == (599, 475)
    assert (events.p == 1).sum() == 367_855
    assert recording.notes["serial_number"] == "30384338" and not str(recording.log)


def test_real_evt3(samples: Path) -> None:
    recording = open_evt(samples / "prophesee/evt3_sample.raw")
    events = recording.load()
    assert (recording.layout, recording.size) == ("EVT3", HD)
    assert len(events) == 219_596
    assert (events.t_us[0], events.t_us[-1]) == (11_718_656, 11_727_457)
    other = np.load(samples / "prophesee/evt3_sample.npy")
    for ours, theirs in (
        (events.x, other["x"]),
        (events.y, other["y"]),
        (events.p > 0, other["p"]),
    ):
        np.testing.assert_array_equal(ours, theirs)
    assert not str(recording.log)


def test_a_file_is_read_as_often_as_one_likes(tmp_path: Path) -> None:
    recording = open_evt(write(tmp_path, evt3_header(), random_evt3(500) + b"\x00"))
    first = listed(recording.load())
    assert listed(recording.load()) == first
    assert recording.triggers is not None
    edges = recording.triggers()
    assert 0 < len(edges.t_us) < 10 and (np.diff(edges.t_us) >= 0).all()
    assert str(recording.log) == "1 truncated words"


def test_a_header_may_end_without_saying_so(tmp_path: Path) -> None:
    data = evt3(high3(0), low3(1), y3(1), x3(0x25, 1))
    path = write(tmp_path, "% evt 3.0\n% geometry 64x48\n", data)
    assert listed(open_evt(path).load()) == [(0x25, 1, 1, 1)]


def test_a_file_without_events_is_empty(tmp_path: Path) -> None:
    assert len(open_evt(write(tmp_path, evt3_header())).load()) == 0


@pytest.mark.parametrize(
    ("line", "size"),
    [
        ("geometry 640x512", (640, 512)),
        ("format EVT3;width=320;height=240", (320, 240)),
        ("plugin_name evc3a_plugin_gen31", (640, 480)),
        ("plugin_name hal_plugin_genx320_evk3", (320, 320)),
        ("system_ID 49", (1280, 720)),
    ],
)
def test_sizes(line: str, size: tuple[int, int], tmp_path: Path) -> None:
    assert open_evt(write(tmp_path, f"% evt 3.0\n% {line}\n")).size == size


@pytest.mark.parametrize(
    ("header", "legacy"),
    [
        ("% format EVT21;width=64;height=64;endianness=legacy\n% end\n", True),
        ("% format EVT21;width=64;height=64\n% endianness little\n% end\n", False),
        ("% evt 2.1\n% geometry 64x64\n% system_ID 49\n% end\n", True),
        ("% evt 2.1\n% geometry 64x64\n% system_ID 64\n% end\n", False),
    ],
)
def test_order_of_halves(header: str, legacy: bool, tmp_path: Path) -> None:
    data = evt21(high21(64), vector21(32, 1, 64, 1, 2), legacy=legacy)
    assert listed(open_evt(write(tmp_path, header, data)).load()) == [(33, 1, 64, 1)]


def test_events_outside_the_sensor_are_dropped_and_counted(tmp_path: Path) -> None:
    data = evt3(high3(0), low3(1), y3(1), *(x3(i, 1) for i in range(70)))
    recording = open_evt(write(tmp_path, evt3_header((64, 48)), data))
    assert len(recording.load()) == 64
    assert str(recording.log) == "6 events outside the sensor"


# Errors


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("% evt 3.0\n% end\n", "does not state its sensor resolution"),
        ("% geometry 64x48\n", "does not say how its events are encoded"),
        ("hello", "no header"),
        ("% evt 4.0\n% geometry 64x48\n", "cannot be read here"),
        ("% format HISTO3D;width=320;height=320\n", "HISTO3D"),
        ("% evt 3.0\n% geometry 64x48\n% width 32\n% height 24\n", "32 x 24 and 64 x 48"),
        ("% format EVT21;width=64;height=64;endianness=odd\n", "unknown order of bytes"),
    ],
)
def test_headers_that_do_not_do(header: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=message):
        open_evt(write(tmp_path, header))


def test_what_the_header_does_not_say_may_be_given(tmp_path: Path) -> None:
    data = evt3(high3(0), low3(1), y3(1), x3(4, 1))
    path = write(tmp_path, "% end\n", data)
    assert listed(open_evt(path, ReaderOptions(size=(64, 48), event_encoding="evt3")).load()) == [
        (4, 1, 1, 1)
    ]
    with pytest.raises(OptionError, match="unknown encoding"):
        open_evt(path, ReaderOptions(size=(64, 48), event_encoding="evt9"))


def test_another_encoding_is_noticed(tmp_path: Path) -> None:
    path = write(tmp_path, EVT2_HEADER, random_evt3(2000))
    with pytest.raises(CaptureError, match="the data are no EVT2|not ascending"):
        open_evt(path).load()
    legacy = evt21(*np.frombuffer(random_evt21(50), "<u8").tolist(), legacy=True)
    with pytest.raises(CaptureError, match=r"EVT2\.1"):
        open_evt(write(tmp_path, EVT21_HEADER, legacy)).load()


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="recording not found"):
        open_evt(tmp_path / "no.raw")


# Headers as other programs write them


@pytest.mark.parametrize(
    "header",
    [
        "% evt 3.0\r\n% geometry 64x48\r\n% end\r\n",
        "% EVT 3.0\n% Width 64\n% Height 48\n",
        "%evt 3\n%width 64\n%height 48\n%end\n",
        "% format EVT3;Height=48;Width=64\n%\n% end\n",
        "% format EVT3.0\n% geometry 64 x 48\n% END\n",
        "% evt 3.0\n% geometry\t64X48\n% remark \u00e4\n% end\n",
    ],
)
def test_headers_of_many_hands(header: str, tmp_path: Path) -> None:
    data = evt3(high3(0), low3(1), y3(1), base3(56, 1), 0x4FFF, x3(63, 0))
    for encoding in ("utf-8", "latin-1"):
        path = write(tmp_path, header.encode(encoding), data)
        assert format_of(path) == "evt"
        recording = open_evt(path)
        assert recording.size == (64, 48)
        # The vector crosses the right edge.
        found = [(x, p) for x, _, _, p in listed(recording.load())]
        assert found == [(56 + i, 1) for i in range(8)] + [(63, -1)]
        assert str(recording.log) == "4 events outside the sensor"


def test_a_header_alone_whose_last_line_does_not_end(tmp_path: Path) -> None:
    for last in ("% geometry 64x48", "% geometry 64x48\n% end"):
        recording = open_evt(write(tmp_path, f"% evt 3.0\n{last}"))
        assert recording.size == (64, 48) and not len(recording.load())


def test_the_caller_decides_between_sizes(tmp_path: Path) -> None:
    path = write(tmp_path, "% evt 3.0\n% geometry 64x48\n% width 32\n% height 24\n% end\n")
    assert open_evt(path, ReaderOptions(size=(32, 24))).size == (32, 24)
    with pytest.raises(CaptureError, match="more than one size"):
        open_evt(path, ReaderOptions(size=(16, 16)))
    path = write(tmp_path, "% evt 3.0\n% plugin_name hal_plugin_gen31_fx3\n% end\n")
    assert open_evt(path, ReaderOptions(size=(320, 240))).size == (320, 240)
    path = write(tmp_path, "% evt 3.0\n% geometry 64x48\n% end\n")
    with pytest.raises(CaptureError, match="the size given is not the one in the file"):
        open_evt(path, ReaderOptions(size=(320, 240)))
