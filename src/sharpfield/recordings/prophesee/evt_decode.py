"""Decoders of Prophesee's event encodings EVT2, EVT2.1 and EVT3, in compiled loops over words.

    EVT2    32-bit words, type in bits 28-31: 0 event, darker · 1 event, brighter · 8 counter, bits
            0-27 · 10 trigger edge, channel in 8-12, edge in 0. Events and edges have the low time
            in 22-27, events x in 11-21 and y in 0-10
    EVT2.1  64-bit words: the upper half as in EVT2; an event word holds up to 32 events of one row,
            x of the first pixel and one bit per pixel in the lower half
    EVT3    16-bit words, type in bits 12-15: 0 row in 0-10 · 1 row of exposure measurements
            · 2 event, x in 0-10, polarity in 11 · 3 x, polarity of the next vector · 4, 5 vector,
            one bit for each of the next 12, 8 pixels · 6 low time, 12 bits · 8 counter, 12 bits
            · 10 trigger edge, channel in 8-11, edge in 0

Vocabulary: the *counter* is the high part of the time as a word holds it, which wraps; `HIGH` is
the same unwrapped. Times are in us: the counter counts 64 us (EVT2, EVT2.1) or 4096 us (EVT3).

A decoder is a loop over words that keeps its state in an array of numbers, so that a file may be
cut into blocks anywhere. It stops early when the output is full, or when it needs the words after
a block to judge one in it (see `is_outlier`).

Source: Prophesee, *EVT 2.0*, *EVT 2.1* and *EVT 3.0 format* (Metavision documentation). A new
counter in EVT3 sets the low part to zero until its own word comes, a repeated one does not.
"""

from typing import no_type_check

import numpy as np
from numba import njit

HIGH, STARTED, LOW, ROW, BASE, SIGN, UNTIMED, UNCONFIRMED, UNKNOWN = range(9)
"""Decoder state: the unwrapped counter and whether there was one; for EVT3 the low time, row (or
`NO_ROW`), column and polarity of the next vector; and counts of what was left out."""

STATE_SIZE = 9
"""Length of the state array."""

NO_ROW, OTHER_ROW = -1, -2
"""No row yet; and a row of exposure measurements, which are no events."""

MAX_PER_WORD = 32
"""Most events that one word can hold."""

MAX_STEP_US = 2**18
"""The counter normally advances by less than this: cameras write it every few us."""

LOOKAHEAD = 2**16
"""Within how many words the next counter is searched to confirm one."""

DE_BRUIJN = 0x077CB531
LOWEST = np.zeros(32, np.int64)
"""Index of the lowest set bit of a 32-bit word w, at `(w & -w) * DE_BRUIJN >> 27`."""
LOWEST[[(DE_BRUIJN << k & 0xFFFFFFFF) >> 27 for k in range(32)]] = np.arange(32)


@njit(cache=True, nogil=True)
@no_type_check
def decode_evt2(words, state, last, columns, end, edges):
    """Decode EVT2, from 32-bit words.

    Args:
        words: The next words.
        state: `STATE_SIZE` numbers, initially zero except `ROW` = `NO_ROW`; updated.
        last: Whether no words follow these.
        columns: x, y, t and p, written from index `end` on.
        end: Number of events in the columns.
        edges: Rows of time, edge and channel, written from index 0 on.

    Returns:
        Number of words used, of events in the columns, and of edges found.
    """
    x, y, t, p = columns
    e, found = np.uint64(end), 0
    high, live = state[HIGH] << 6, state[STARTED] > 0
    most = min(words.size, t.size - MAX_PER_WORD + 1 - end)
    for i in range(most):
        word = np.int64(words[i])
        kind = word >> 28
        if kind <= 1:
            if live:
                x[e], y[e] = (word >> 11) & 0x7FF, word & 0x7FF
                t[e], p[e] = high | ((word >> 22) & 0x3F), 2 * kind - 1
                e += np.uint64(1)
            else:
                state[UNTIMED] += 1
        elif kind == 0x8:
            if not _advance(words, i, state, last, 28, 0):
                return i, np.int64(e), found
            high, live = state[HIGH] << 6, True
        elif kind == 0xA and live:
            if found == len(edges):
                return i, np.int64(e), found
            _edge(edges, found, high | ((word >> 22) & 0x3F), word, 0x1F)
            found += 1
        elif kind <= 0x7 or kind == 0x9:
            state[UNKNOWN] += 1
    return most, np.int64(e), found


@njit(cache=True, nogil=True)
@no_type_check
def decode_evt21(words, state, last, columns, end, edges):
    """Decode EVT2.1, from 64-bit words with the type in the top bits; see `decode_evt2`."""
    limit = columns[2].size - MAX_PER_WORD
    found = 0
    high, live = state[HIGH] << 6, state[STARTED] > 0
    for i in range(words.size):
        if end > limit:
            return i, end, found
        word = np.int64(words[i] >> np.uint64(32))
        kind = word >> 28
        if kind <= 1:
            bits = np.int64(words[i] & np.uint64(0xFFFFFFFF))
            if live:
                time = high | ((word >> 22) & 0x3F)
                column, row, sign = (word >> 11) & 0x7FF, word & 0x7FF, 2 * kind - 1
                end = _vector(columns, end, bits, column, row, time, sign)
            else:
                state[UNTIMED] += _ones(bits)
        elif kind == 0x8:
            if not _advance(words, i, state, last, 60, 32):
                return i, end, found
            high, live = state[HIGH] << 6, True
        elif kind == 0xA and live:
            if found == len(edges):
                return i, end, found
            _edge(edges, found, high | ((word >> 22) & 0x3F), word, 0x1F)
            found += 1
        elif kind <= 0x7 or kind == 0x9 or (kind >= 0xB and kind <= 0xD):
            state[UNKNOWN] += 1
    return words.size, end, found


@njit(cache=True, nogil=True)
@no_type_check
def decode_evt3(words, state, last, columns, end, edges):
    """Decode EVT3, from 16-bit words; see `decode_evt2`."""
    x, y, t, p = columns
    limit = t.size - MAX_PER_WORD
    used, found = words.size, 0
    row, base, sign = state[ROW], state[BASE], state[SIGN]
    time = state[HIGH] << 12 | state[LOW]
    live = state[STARTED] > 0 and row >= 0
    for i in range(words.size):
        if end > limit:
            used = i
            break
        word = np.int64(words[i])
        kind = word >> 12
        if kind == 0x2:
            if live:
                e = np.uint64(end)
                x[e], y[e], t[e], p[e] = word & 0x7FF, row, time, ((word >> 10) & 2) - 1
                end += 1
            elif row != OTHER_ROW:
                state[UNTIMED] += 1
        elif kind <= 0x1:
            row = word & 0x7FF if kind == 0 else OTHER_ROW
            live = state[STARTED] > 0 and row >= 0
        elif kind == 0x6:
            state[LOW] = word & 0xFFF
            time = state[HIGH] << 12 | state[LOW]
        elif kind == 0x3:
            base, sign = word & 0x7FF, ((word >> 10) & 2) - 1
        elif kind <= 0x5:
            bits = word & (0xFFF if kind == 0x4 else 0xFF)
            if live:
                end = _vector(columns, end, bits, base, row, time, sign)
            elif row != OTHER_ROW:
                state[UNTIMED] += _ones(bits)
            base = min(base + (12 if kind == 0x4 else 8), 0x7FFF)
        elif kind == 0x8:
            before = state[HIGH]
            if not _advance(words, i, state, last, 12, 0):
                used = i
                break
            state[LOW] = state[LOW] if state[HIGH] == before else 0
            time = state[HIGH] << 12 | state[LOW]
            live = row >= 0
        elif kind == 0xA and state[STARTED] > 0:
            if found == len(edges):
                used = i
                break
            _edge(edges, found, time, word, 0xF)
            found += 1
        elif kind == 0x9 or kind == 0xB or kind == 0xC:
            state[UNKNOWN] += 1
    state[ROW], state[BASE], state[SIGN] = row, base, sign
    return used, end, found


@njit(cache=True, nogil=True)
@no_type_check
def _edge(edges, found, time, word, channels):
    edges[found, 0], edges[found, 1] = time, 2 * (word & 1) - 1
    edges[found, 2] = (word >> 8) & channels


@njit(cache=True, nogil=True)
@no_type_check
def _vector(columns, end, bits, column, row, time, sign):
    """Write an event for each set bit of a 32-bit mask, the lowest at `column`."""
    x, y, t, p = columns
    e = np.uint64(end)  # unsigned: numba would look for negative indices
    while bits:
        lowest = bits & -bits
        x[e] = column + LOWEST[(lowest * DE_BRUIJN & 0xFFFFFFFF) >> 27]
        y[e], t[e], p[e] = row, time, sign
        e += np.uint64(1)
        bits ^= lowest
    return np.int64(e)


@njit(cache=True, nogil=True)
@no_type_check
def _ones(bits):
    count = 0
    while bits:
        bits &= bits - 1
        count += 1
    return count


@njit(cache=True, nogil=True)
@no_type_check
def _advance(words, i, state, last, kind_at, counter_at):
    """Update the state with the counter of word i; False if later words are needed to judge it."""
    mask = 0xFFF if kind_at == 12 else 0xFFFFFFF
    near = MAX_STEP_US >> (12 if kind_at == 12 else 6)
    counter = (np.int64(words[i]) >> counter_at) & mask
    if not state[STARTED]:
        state[HIGH], state[STARTED] = counter, 1
        return True
    ahead = wrapped_step(state[HIGH] & mask, counter, mask, near)
    if abs(ahead) > near:
        following = _following(words, i, last, kind_at, counter_at, mask)
        if following == -2:
            return False
        if following >= 0 and is_outlier(state[HIGH] & mask, counter, following, mask, near):
            state[UNCONFIRMED] += 1
            return True
    state[HIGH] += ahead
    return True


@njit(cache=True, nogil=True)
@no_type_check
def wrapped_step(before, counter, mask, near):
    """Change of a counter, negative if it went back; wraps are undone."""
    ahead = (counter - before) & mask
    back = mask + 1 - ahead
    if ahead <= back or (back > near and counter > before):
        return ahead
    return -back


@njit(cache=True, nogil=True)
@no_type_check
def is_outlier(before, counter, following, mask, near):
    """Whether a counter is a single outlier: the next one continues from the one before.

    Otherwise one wrong bit would make time jump, and the jump back would pass for a wrap.
    """
    continues = abs(wrapped_step(before, following, mask, near)) <= near
    return continues and abs(wrapped_step(counter, following, mask, near)) > near


@njit(cache=True, nogil=True)
@no_type_check
def _following(words, i, last, kind_at, counter_at, mask):
    """The next counter within `LOOKAHEAD` words; -1 if none, -2 if more words are needed."""
    for j in range(i + 1, min(i + LOOKAHEAD, words.size)):
        if (np.uint64(words[j]) >> np.uint64(kind_at)) == 8:
            return (np.int64(words[j]) >> counter_at) & mask
    return -1 if last or i + LOOKAHEAD <= words.size else -2
