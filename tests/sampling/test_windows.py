"""Windows of events: exact counts against a slow loop, and what half a batch promises."""

import numpy as np
import torch

from sharpfield.sampling.binned import (
    binned_table,
    draw_binned,
    halve,
    halve_as_released,
    open_windows,
)
from sharpfield.sampling.event_windows import Lengths, draw_spans, draw_windows
from sharpfield.sampling.pixels_and_pairs import pair_table
from sharpfield.storage.event_cache import event_index
from tests.recipes.moving import tiny_moving

CAPTURE = tiny_moving()
EVENTS = CAPTURE.needed_events
INDEX = event_index(EVENTS)
TABLE = pair_table(CAPTURE, INDEX)


def slow_counts(seen, i: int) -> tuple[int, int]:
    """Events of one window, one by one."""
    start, end = (int(CAPTURE.clock.us(float(t))) for t in (seen.start[i], seen.end[i]))
    x, y = (int(v) for v in seen.xy[i].floor())
    here = (EVENTS.x == x) & (EVENTS.y == y) & (EVENTS.track == int(seen.track[i]))
    signs = EVENTS.p[here & (EVENTS.t_us > start) & (EVENTS.t_us <= end)]
    return -int((signs < 0).sum()), int((signs > 0).sum())


def agree(seen) -> None:
    for i in range(len(seen)):
        assert (int(seen.negative[i]), int(seen.positive[i])) == slow_counts(seen, i)


def test_counts_of_windows_and_spans_are_exact():
    agree(draw_windows(TABLE, 60, Lengths(), seed=0, step=3))
    agree(draw_spans(TABLE, 60, seed=0, step=3))


def test_a_share_of_the_windows_holds_an_event():
    seen = draw_windows(TABLE, 80, Lengths(), seed=1, step=0, busy=0.5)
    assert ((seen.positive - seen.negative)[:40] > 0).all()
    assert (seen.end > seen.start).all()


def test_lengths_are_even_in_the_logarithm():
    lengths = Lengths(shortest=1 / 64, longest=1 / 4, until=0.5)
    seen = draw_windows(TABLE, 4000, lengths, seed=0, step=0)
    assert seen.end.max() <= 0.5 + 1e-5
    log = (seen.end - seen.start).log2()
    assert log.min() >= -6.1 and log.max() <= -1.9
    assert abs(float((log < -4).float().mean()) - 0.5) < 0.05


def test_spans_begin_and_end_with_events():
    seen = draw_spans(TABLE, 50, seed=0, step=1)
    times = set(EVENTS.t_us.tolist())
    for instants in (seen.start, seen.end):
        assert {int(CAPTURE.clock.us(float(t))) for t in instants} <= times
    assert ((seen.positive - seen.negative) >= 1).all()


def test_draws_depend_on_seed_and_step():
    first = draw_windows(TABLE, 20, Lengths(), seed=0, step=0)
    assert torch.equal(first.start, draw_windows(TABLE, 20, Lengths(), seed=0, step=0).start)
    assert not torch.equal(first.start, draw_windows(TABLE, 20, Lengths(), seed=0, step=1).start)
    assert set(first.track.tolist()) == {0, 1, 2}


def test_event_frames_add_up_to_the_stream():
    table = binned_table(INDEX, CAPTURE.clock, 5, CAPTURE.camera.size)
    assert table.net.sum() == EVENTS.p.astype(np.int64).sum()
    agree_with = binned_table(INDEX, CAPTURE.clock, 10, CAPTURE.camera.size)
    np.testing.assert_array_equal(agree_with.net[:, ::2] + agree_with.net[:, 1::2], table.net)


def test_half_of_a_binned_batch_are_event_pixels():
    table = binned_table(INDEX, CAPTURE.clock, 6, CAPTURE.camera.size)
    seen = draw_binned(table, 64, seed=0, step=9, until=3)
    net = seen.negative + seen.positive
    assert len(seen) == 64
    assert (net[:32] != 0).all()
    assert (seen.start <= 2 / 6 + 1e-6).all()
    torch.testing.assert_close(seen.end - seen.start, torch.full((64,), 1 / 6))
    for i in range(64):
        v = table.track.tolist().index(int(seen.track[i]))
        x, y = (int(c) for c in seen.xy[i].floor())
        assert table.net[v, round(float(seen.start[i]) * 6), y, x] == int(net[i])


def test_a_crop_holds_every_pixel():
    table = binned_table(INDEX, CAPTURE.clock, 6, CAPTURE.camera.size)
    seen = draw_binned(table, 200, seed=0, step=0, until=6, cropped=True)
    spread = seen.xy.amax(0) - seen.xy.amin(0)
    assert (spread <= 7).all(), "half of 16 pixels"


def test_windows_open_one_after_another():
    found = [open_windows(step, 31, 20_000) for step in (0, 10_000, 19_999, 20_000, 90_000)]
    assert found == [3, 16, 31, 31, 31]


def test_only_the_fair_halving_treats_signs_alike():
    net = np.random.default_rng(0).integers(-9, 10, (3, 8, 8)).astype(np.int32)
    np.testing.assert_array_equal(halve(-net), -halve(net))
    released = halve_as_released(0.2 * net)
    assert (halve_as_released(-0.2 * net) != -released).any()
    one_darker = np.zeros((2, 2))
    one_darker[0, 0] = -0.2
    assert halve_as_released(one_darker)[0, 0] == -1
    assert halve(np.array([[-1, 0], [0, 0]], np.int32))[0, 0] == 0


def test_blocks_look_from_their_middles():
    table = binned_table(INDEX, CAPTURE.clock, 2, CAPTURE.camera.size, halved="fairly")
    assert table.net.shape == (3, 2, 8, 8)
    seen = draw_binned(table, 16, seed=0, step=0, until=2)
    assert torch.equal(seen.xy % 2, torch.ones_like(seen.xy))
