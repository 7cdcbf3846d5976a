"""A camera as a table of `capture.toml`: the fields of `Camera`, by their names."""

import dataclasses
from typing import Any

from sharpfield.captures.toml_tables import Table
from sharpfield.core.camera import Camera


def camera_table(camera: Camera) -> dict[str, Any]:
    """What describes a camera."""
    table = dataclasses.asdict(camera)
    return table | {"distortion": list(camera.distortion)}


def read_camera(table: Table) -> Camera:
    """Read what `camera_table` describes.

    Raises:
        CaptureError: A value is missing, malformed or unknown.
    """
    table.expect_only(*(field.name for field in dataclasses.fields(Camera)))
    return Camera(
        width=table.whole("width"),
        height=table.whole("height"),
        fx_px=table.number("fx_px"),
        fy_px=table.number("fy_px"),
        cx_px=table.number("cx_px"),
        cy_px=table.number("cy_px"),
        lens=table.text("lens", "pinhole"),
        distortion=table.numbers("distortion", []),
    )
