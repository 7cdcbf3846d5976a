"""Rules by which published data sets hold out test frames.

A rule is written `every:8` (frames 0, 8, 16, ...), `train:5` (all but frames 0, 5, 10, ...),
`last:5` or `none`.
"""

import re

import numpy as np

from sharpfield.core.capture import Split
from sharpfield.core.errors import CaptureError, OptionError

RULE = re.compile(r"(?P<kind>every|train|last):(?P<number>[1-9][0-9]*)|none")


def split_by_rule(count: int, rule: str) -> Split:
    """The training frames and the held-out frames among `count` frames.

    Raises:
        OptionError: The rule is malformed.
        CaptureError: It leaves no training frames.
    """
    match = RULE.fullmatch(rule)
    if match is None:
        raise OptionError(
            "unknown hold-out rule",
            got=rule,
            do="write every:8, train:5, last:5 or none",
        )
    every = np.arange(count, dtype=np.int64)
    number = int(match["number"] or 0)
    if match["kind"] == "every":
        held_out = every % number == 0
    elif match["kind"] == "train":
        held_out = every % number != 0
    else:
        held_out = every >= count - number
    if held_out.all():
        raise CaptureError(
            "no training frame is left",
            got=f"{count} frames, hold-out rule {rule}",
            do="hold out fewer frames",
        )
    return Split(train=every[~held_out], test=every[held_out])
