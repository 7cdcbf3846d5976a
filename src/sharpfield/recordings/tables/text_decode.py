"""Parser for lines of four numbers, one event each, in integer arithmetic.

A number is kept as an integer mantissa and a power of ten, `13.582595999` as 13582595999 and -9, so
that times are as exact as the text has them (rounded to the nearest us, halves upwards).
"""

from typing import no_type_check

import numpy as np
from numba import njit

LINES, INVALID, FIRST_INVALID, ZEROS, MINUSES, EVENTS = range(6)
"""Parser state: number of lines, of invalid ones and the first of them, whether a polarity was 0
and whether one was -1, and number of events."""

STATE_SIZE = 6
"""Length of the state array."""

DIGITS = 18
"""Digits that an int64 always holds; further digits are dropped."""

TENS = 10 ** np.arange(DIGITS + 1)
"""Powers of ten."""

FULL = 10 ** (DIGITS - 1)
"""Smallest mantissa that takes no more digits."""

OUTSIDE = 0xFFFF
"""Column or row of coordinates that do not fit in 16 bits."""

NEWLINE, POINT, MINUS, PLUS, ZERO, NINE = (ord(sign) for sign in "\n.-+09")
HASH, PERCENT, SMALL_E, LARGE_E = (ord(sign) for sign in "#%eE")


@njit(cache=True, nogil=True)
@no_type_check
def decode_lines(text, state, layout, columns, end):
    """Parse whole lines.

    Args:
        text: Bytes; those after the last newline are not used.
        state: `STATE_SIZE` numbers, initially zero; updated.
        layout: Column index of t, x, y and p, and the power of ten that converts times to us.
        columns: x, y, t and p, written from index `end` on until they are full.
        end: Number of events in the columns.

    Returns:
        Number of bytes used, and of events in the columns.
    """
    x, y, t, p = columns
    mantissa, power = np.empty(4, np.int64), np.empty(4, np.int64)
    at = 0
    while end < t.size:
        stop = at
        while stop < text.size and text[stop] != NEWLINE:
            stop += 1
        if stop == text.size:
            break
        state[LINES] += 1
        first = _skip(text, at, stop)
        at_line, at = at, stop + 1
        if first == stop or text[first] == HASH or text[first] == PERCENT:
            continue
        valid = _numbers(text, at_line, stop, mantissa, power)
        if valid:
            time, valid = _whole_us(mantissa[layout[0]], power[layout[0]] + layout[4])
        if valid:
            x[end], valid = _pixel(mantissa[layout[1]], power[layout[1]])
        if valid:
            y[end], valid = _pixel(mantissa[layout[2]], power[layout[2]])
        if valid:
            sign, valid = _pixel(abs(mantissa[layout[3]]), power[layout[3]])
            valid = valid and sign <= 1
        if not valid:
            state[FIRST_INVALID] = state[LINES] if state[INVALID] == 0 else state[FIRST_INVALID]
            state[INVALID] += 1
            continue
        bright = sign == 1 and mantissa[layout[3]] > 0
        state[ZEROS] |= sign == 0
        state[MINUSES] |= sign == 1 and not bright
        t[end], p[end] = time, 1 if bright else -1
        end += 1
        state[EVENTS] += 1
    return at, end


@njit(cache=True, nogil=True)
@no_type_check
def _skip(text, at, stop):
    """Index of the next byte that is no separator."""
    while at < stop:
        sign = text[at]
        if sign != 32 and sign != 9 and sign != 13 and sign != 44 and sign != 59:  # space \t \r , ;
            break
        at += 1
    return at


@njit(cache=True, nogil=True)
@no_type_check
def _numbers(text, at, stop, mantissa, power):
    """Parse exactly four numbers; False if the line is anything else."""
    for k in range(4):
        at = _skip(text, at, stop)
        start = at
        negative = at < stop and text[at] == MINUS
        if at < stop and (text[at] == MINUS or text[at] == PLUS):
            at += 1
        value, exponent, digits, point = 0, 0, 0, False
        while at < stop:
            sign = text[at]
            if sign >= ZERO and sign <= NINE:
                if value < FULL:
                    value = 10 * value + (np.int64(sign) - ZERO)
                    exponent -= point
                else:
                    exponent += not point
                digits += 1
            elif sign == POINT and not point:
                point = True
            else:
                break
            at += 1
        if digits == 0 or at - start > 64:
            return False
        if at < stop and (text[at] == SMALL_E or text[at] == LARGE_E):
            more, at = _exponent(text, at + 1, stop)
            if at < 0:
                return False
            exponent += more
        if at < stop and _skip(text, at, stop) == at:
            return False
        mantissa[k], power[k] = -value if negative else value, exponent
    return _skip(text, at, stop) == stop


@njit(cache=True, nogil=True)
@no_type_check
def _exponent(text, at, stop):
    negative = at < stop and text[at] == MINUS
    if at < stop and (text[at] == MINUS or text[at] == PLUS):
        at += 1
    value, start = 0, at
    while at < stop and text[at] >= ZERO and text[at] <= NINE and at - start < 4:
        value = 10 * value + (np.int64(text[at]) - ZERO)
        at += 1
    return -value if negative else value, at if at > start else -1


@njit(cache=True, nogil=True)
@no_type_check
def _whole_us(mantissa, power):
    """Nearest integer, and whether it is within 2^62."""
    if mantissa == 0 or power < -DIGITS:
        return 0, True
    if power >= 0:
        if power > DIGITS or abs(mantissa) > 2**62 // TENS[power]:
            return 0, False
        return mantissa * TENS[power], True
    unit = TENS[-power]
    return (mantissa + unit // 2) // unit, True


@njit(cache=True, nogil=True)
@no_type_check
def _pixel(mantissa, power):
    """Pixel coordinate, and whether it is an integer."""
    if power < 0:
        unit = TENS[min(-power, DIGITS)]
        if mantissa % unit:
            return OUTSIDE, False
        mantissa //= unit
    elif power > 0 and mantissa < OUTSIDE:
        mantissa *= TENS[min(power, 5)]
    return (mantissa if mantissa >= 0 and mantissa < OUTSIDE else OUTSIDE), True
