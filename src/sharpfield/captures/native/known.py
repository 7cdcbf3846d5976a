"""The table `[known]` of `capture.toml`, see `core.capture.Known`.

    poses, motion, intrinsics, bounds       "known" (the default), "estimated" or "unknown"
    threshold_negative, threshold_positive  contrast thresholds, natural log; both or neither
    thresholds                              "known" (the default) or "estimated"
    log_floor, refractory_us                numbers of the event camera
    background                              "white" if images were composited on white
    reference_poses                         "frames" (the default) or "trajectory"

Captures that were written before this table existed state the same in `[notes]`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, get_args

import numpy as np

from sharpfield.core.capture import USUAL_THRESHOLD, Certainty, Known, Note, Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.storage.toml_tables import Table

CERTAINTIES = ("poses", "motion", "intrinsics", "bounds")
WORDS, NUMBERS = ("background", "reference_poses"), ("log_floor", "refractory_us")
CHOICES = {
    **dict.fromkeys(CERTAINTIES, get_args(Certainty)),
    "background": ("", "white"),
    "reference_poses": ("frames", "trajectory"),
}
"""Values that words in the table may take."""
THRESHOLDS = ("threshold_negative", "threshold_positive")
OLD_THRESHOLDS = ("threshold_off", "threshold_on")
KEYS = (*CERTAINTIES, "thresholds", *THRESHOLDS, *NUMBERS, *WORDS)


def known_table(known: Known) -> dict[str, Any]:
    """The values of the table; what is not known is left out."""
    table: dict[str, Any] = {name: getattr(known, name) for name in (*CERTAINTIES, *WORDS)}
    table |= {name: getattr(known, name) for name in NUMBERS}
    if known.thresholds is not None:
        table["thresholds"] = known.thresholds.certainty
        table |= dict(
            zip(THRESHOLDS, (known.thresholds.negative, known.thresholds.positive), strict=True)
        )
    return {
        name: float(value) if name in (*NUMBERS, *THRESHOLDS) else value
        for name, value in table.items()
        if value not in (None, "")
    }


def read_known(table: Table) -> Known:
    """Read what `known_table` describes.

    Raises:
        CaptureError: A key or value is unknown, or one of two thresholds is missing.
    """
    table.expect_only(*KEYS)
    values: dict[str, Any] = {
        name: _choice(table, name, allowed)
        for name, allowed in CHOICES.items()
        if name in table.values
    }
    values |= {name: table.number(name) for name in NUMBERS if name in table.values}
    if any(name in table.values for name in (*THRESHOLDS, "thresholds")):
        negative, positive = (table.number(name) for name in THRESHOLDS)
        certainty = _choice(table, "thresholds", ("known", "estimated"), "known")
        values["thresholds"] = Thresholds(negative, positive, certainty)
    try:
        return Known(**values)
    except CaptureError as error:
        raise CaptureError(error.what, where=table.where, got=error.got, do=error.do) from None


def _choice(table: Table, name: str, allowed: Sequence[str], fallback: str | None = None) -> Any:
    value = table.text(name, fallback)
    if value not in allowed:
        raise CaptureError(
            f"unknown value of `{name}`",
            where=table.where,
            got=repr(value),
            do=f"use one of {', '.join(map(repr, allowed))}, or leave it out",
        )
    return value


def known_from_notes(notes: Mapping[str, Note]) -> tuple[Known, dict[str, Note]]:
    """What the notes of an older capture state, and the notes that remain remarks."""
    left = dict(notes)
    values: dict[str, Any] = {}
    for name in CERTAINTIES:
        note = left.get(name)
        if note == "unknown":
            values[name] = left.pop(name)
        elif name == "bounds" and note is not None:  # "guessed from where the cameras look"
            values[name] = "estimated"
    if left.get("motion") == "none":  # sharp renderings
        del left["motion"]
    values |= {name: str(left.pop(name)) for name in WORDS if name in left}
    for name in NUMBERS:
        if isinstance(left.get(name), float | int):
            values[name] = float(left.pop(name))  # pyright: ignore[reportArgumentType]
    if any(name in left for name in OLD_THRESHOLDS):
        # Where pixels had thresholds of their own, the median over them counts.
        stated = [left.pop(name, USUAL_THRESHOLD) for name in OLD_THRESHOLDS]
        negative, positive = (float(np.median(np.asarray(one, float))) for one in stated)
        values["thresholds"] = Thresholds(negative, positive)
    return Known(**values), left
