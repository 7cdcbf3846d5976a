"""Lines of four numbers, an event each, parsed as they are: no float on the way to microseconds.

A number is kept as a whole mantissa and a power of ten, `13.582595999` as 13582595999 and -9, so
that times come out as exact as the text has them (nearest us, halves upwards).
"""

from typing import no_type_check

import numpy as np
from numba import njit

LINES, BAD, BAD_LINE, ZEROS, MINUSES, SEEN = range(6)
"""What a parser remembers: lines so far, how many could not be read and the first of them, whether
a polarity was 0 and whether one was -1, and events so far."""

REMEMBERED = 6
"""How many numbers that is."""

DIGITS = 18
"""Those that an int64 surely holds; further ones are dropped."""

TENS = 10 ** np.arange(DIGITS + 1)
"""Powers of ten."""

FULL = 10 ** (DIGITS - 1)
"""The least mantissa that takes no more digits."""

OUTSIDE = 0xFFFF
"""Column or row of what no 16-bit number holds."""

NEWLINE, POINT, MINUS, PLUS, ZERO, NINE = (ord(sign) for sign in "\n.-+09")
HASH, PERCENT, SMALL_E, LARGE_E = (ord(sign) for sign in "#%eE")


@njit(cache=True, nogil=True)
@no_type_check
def decode_lines(text, state, layout, columns, end):
    """Parse whole lines.

    Args:
        text: Bytes; what follows the last newline is left.
        state: `REMEMBERED` numbers, zero at first; updated.
        layout: In which column t, x, y and p are, and the power of ten that makes times us.
        columns: x, y, t and p, written from `end` on until they are full.
        end: How many events there are already.

    Returns:
        How many bytes were used up, and how many events there are now.
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
        good = _numbers(text, at_line, stop, mantissa, power)
        if good:
            time, good = _whole_us(mantissa[layout[0]], power[layout[0]] + layout[4])
        if good:
            x[end], good = _pixel(mantissa[layout[1]], power[layout[1]])
        if good:
            y[end], good = _pixel(mantissa[layout[2]], power[layout[2]])
        if good:
            sign, good = _pixel(abs(mantissa[layout[3]]), power[layout[3]])
            good = good and sign <= 1
        if not good:
            state[BAD_LINE] = state[LINES] if state[BAD] == 0 else state[BAD_LINE]
            state[BAD] += 1
            continue
        bright = sign == 1 and mantissa[layout[3]] > 0
        state[ZEROS] |= sign == 0
        state[MINUSES] |= sign == 1 and not bright
        t[end], p[end] = time, 1 if bright else -1
        end += 1
        state[SEEN] += 1
    return at, end


@njit(cache=True, nogil=True)
@no_type_check
def _skip(text, at, stop):
    """The next place that holds no separator."""
    while at < stop:
        sign = text[at]
        if sign != 32 and sign != 9 and sign != 13 and sign != 44 and sign != 59:  # space \t \r , ;
            break
        at += 1
    return at


@njit(cache=True, nogil=True)
@no_type_check
def _numbers(text, at, stop, mantissa, power):
    """Read exactly four numbers; whether there were."""
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
    """The nearest whole number, and whether an int64 holds it with room to spare."""
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
    """A whole number as a place on the sensor, and whether it is whole."""
    if power < 0:
        unit = TENS[min(-power, DIGITS)]
        if mantissa % unit:
            return OUTSIDE, False
        mantissa //= unit
    elif power > 0 and mantissa < OUTSIDE:
        mantissa *= TENS[min(power, 5)]
    return (mantissa if mantissa >= 0 and mantissa < OUTSIDE else OUTSIDE), True
