"""Ray tracing of rectangles, balls, boxes and cylinders with closed-form textures.

Silhouettes are antialiased over the width of a pixel: a surface *covers* a fraction of a ray, and
the rest continues to the next surface. Light therefore changes continuously as the camera moves, as
for a real pixel, which integrates over an area.

Shading is Lambertian, with one sun with soft shadows and a uniform sky, so radiance does not depend
on the direction. All of it is *linear* radiance in `DARKEST`...1.
"""

from math import asin, atan2, sin, sqrt
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float32, Float64
from numba import njit

from sharpfield.simulation.scenes.textures import TEXT, letters, paint

RECTANGLE, BALL, BOX, CYLINDER = range(4)
"""The surfaces."""

DARKEST = 0.02
"""Smallest radiance, so that logarithms stay finite."""
LAYERS = 6
"""Most partly covering surfaces along a ray; the last one counts as opaque."""
PENUMBRA_RAD = 0.12
"""Angular diameter of the sun."""
NOTHING = 1e9
"""Depth where a ray meets no surface."""
CENTRE, HALF, AXES, REACH = 1, 4, 7, 17
"""Columns of `Surfaces.shape` where centre, half extents and axes begin; that of the radius."""


class Surfaces(NamedTuple):
    """All surfaces of a scene, as numeric tables for compiled code."""

    shape: Float64[np.ndarray, "n 18"]
    """Kind; centre (3); half extents (3; the first is the radius of a ball or cylinder); the linear
    map from the world to the surface's own axes (9; rows are its x, y and z axes unless it is
    deformed; a rectangle faces -z, a cylinder is along y); 1 if it casts a shadow; the radius of
    its bounding ball."""
    look: Float64[np.ndarray, "n 16"]
    """Linear RGB of ground, ink and accent (9); texture, cells per unit, seed, slant; page of text
    and its rows and columns."""
    pages: Float32[np.ndarray, "m r c"]
    """Lettering, see `textures.page`; padded to one size."""
    sway: Float64[np.ndarray, "n 4"]
    """Amplitude of the centre's sway (x, y, z), and its period in seconds."""
    light: Float64[np.ndarray, "4"]
    """Unit vector towards the sun, and the fraction of ambient light."""
    sky: Float64[np.ndarray, "2 3"]
    """Linear RGB of the sky straight ahead and above."""


@njit(cache=True, fastmath=True, nogil=True)
@no_type_check
def trace(surfaces, origin, direction, time_s, footprint):
    """Light and depth of many rays.

    Args:
        surfaces: The scene.
        origin: [n 3] or [1 3] for rays that share it.
        direction: [n 3], any length.
        time_s: Seconds, for sway.
        footprint: Angle between neighbouring pixels, in rad.

    Returns:
        Linear rgb [n 3] and depth [n] in lengths of `direction`, both float32.
    """
    n = len(direction)
    rgb, depth = np.empty((n, 3), np.float32), np.empty(n, np.float32)
    shape = _swayed(surfaces, time_s)
    for r in range(n):
        ray, length = _unit_ray(origin, direction, r)
        red, green, blue, far, _ = _gather(surfaces, shape, ray, footprint)
        rgb[r, 0], rgb[r, 1], rgb[r, 2] = red, green, blue
        depth[r] = far / length
    return rgb, depth


@njit(cache=True, fastmath=True, nogil=True)
@no_type_check
def meet(surfaces, origin, direction, time_s, footprint):
    """The first surface that covers half of each ray, and its depth.

    The arguments are those of `trace`.

    Returns:
        Number of the surface [n], -1 where there is none, and depth [n] in lengths of `direction`.
    """
    n = len(direction)
    which, depth = np.empty(n, np.int64), np.empty(n, np.float64)
    shape = _swayed(surfaces, time_s)
    for r in range(n):
        ray, length = _unit_ray(origin, direction, r)
        _, _, _, far, first = _gather(surfaces, shape, ray, footprint)
        which[r], depth[r] = first, far / length
    return which, depth


@njit(cache=True, fastmath=True)
@no_type_check
def _swayed(surfaces, time_s):
    """The table of shapes with their sway at a time."""
    shape = surfaces.shape.copy()
    for i in range(len(shape)):
        swing = sin(6.283185307179586 * time_s / surfaces.sway[i, 3])
        shape[i, CENTRE : CENTRE + 3] += surfaces.sway[i, :3] * swing
    return shape


@njit(cache=True, fastmath=True, inline="always")
@no_type_check
def _unit_ray(origin, direction, r):
    """Position and unit direction of a ray, and the length of its direction."""
    o = r if len(origin) > 1 else 0
    x, y, z = direction[r, 0], direction[r, 1], direction[r, 2]
    length = sqrt(x * x + y * y + z * z)
    return (origin[o, 0], origin[o, 1], origin[o, 2], x / length, y / length, z / length), length


@njit(cache=True, fastmath=True)
@no_type_check
def _gather(surfaces, shape, ray, footprint):
    """Follow one ray through partly covering surfaces.

    Returns:
        Red, green, blue; the depth of the first surface that covers half, and its number.
    """
    red, green, blue, left, depth, start = 0.0, 0.0, 0.0, 1.0, NOTHING, 1e-4
    first = -1
    for layer in range(LAYERS):
        best, nearest, cover = -1, NOTHING, 0.0
        for i in range(len(shape)):
            t, share = _meet(shape, i, ray, footprint)
            if share > 0.0 and start < t < nearest:
                best, nearest, cover = i, t, share
        if best < 0:
            up = max(0.0, -ray[4])
            red += left * (surfaces.sky[0, 0] * (1 - up) + surfaces.sky[1, 0] * up)
            green += left * (surfaces.sky[0, 1] * (1 - up) + surfaces.sky[1, 1] * up)
            blue += left * (surfaces.sky[0, 2] * (1 - up) + surfaces.sky[1, 2] * up)
            break
        weight = left if layer == LAYERS - 1 else left * cover
        left -= weight
        if depth == NOTHING and left <= 0.5:
            depth, first = nearest, best
        r, g, b = _colour(surfaces, shape, best, ray, nearest, footprint)
        red, green, blue = red + weight * r, green + weight * g, blue + weight * b
        if left < 1e-3:
            break
        start = nearest + 1e-6
    keep = 1.0 / (1.0 - left) if 0.0 < left < 1e-3 else 1.0
    return (
        min(max(red * keep, DARKEST), 1.0),
        min(max(green * keep, DARKEST), 1.0),
        min(max(blue * keep, DARKEST), 1.0),
        depth,
        first,
    )


@njit(cache=True, fastmath=True, inline="always")
@no_type_check
def _within(shape, i, ray):
    """A ray in the axes of a surface: position, direction."""
    x, y, z = ray[0] - shape[i, 1], ray[1] - shape[i, 2], ray[2] - shape[i, 3]
    return (
        shape[i, 7] * x + shape[i, 8] * y + shape[i, 9] * z,
        shape[i, 10] * x + shape[i, 11] * y + shape[i, 12] * z,
        shape[i, 13] * x + shape[i, 14] * y + shape[i, 15] * z,
        shape[i, 7] * ray[3] + shape[i, 8] * ray[4] + shape[i, 9] * ray[5],
        shape[i, 10] * ray[3] + shape[i, 11] * ray[4] + shape[i, 12] * ray[5],
        shape[i, 13] * ray[3] + shape[i, 14] * ray[4] + shape[i, 15] * ray[5],
    )


@njit(cache=True, fastmath=True)
@no_type_check
def _meet(shape, i, ray, footprint):
    """Distance along a unit ray to a surface, and the fraction of the ray that it covers."""
    half = (shape[i, 4], shape[i, 5], shape[i, 6])
    x, y, z = shape[i, 1] - ray[0], shape[i, 2] - ray[1], shape[i, 3] - ray[2]
    along = x * ray[3] + y * ray[4] + z * ray[5]
    apart = max(x * x + y * y + z * z - along * along, 0.0)  # squared, from ray to centre
    width = footprint * along
    if apart > 1.1 * shape[i, REACH] ** 2 + 16.0 * width * width:
        return NOTHING, 0.0
    if shape[i, 0] == BALL:
        if along <= 0.0:
            return NOTHING, 0.0
        aside = sqrt(apart)
        if aside > half[0] + 0.5 * width:
            return NOTHING, 0.0
        cover = min(max((half[0] - aside) / width + 0.5, 0.0), 1.0)
        return along - sqrt(max(half[0] * half[0] - aside * aside, 0.0)), cover
    x, y, z, dx, dy, dz = _within(shape, i, ray)
    if shape[i, 0] == RECTANGLE:
        if abs(dz) < 1e-9:
            return NOTHING, 0.0
        t = -z / dz
        if t <= 0.0:
            return NOTHING, 0.0
        width = footprint * t / max(abs(dz), 0.05)
        a = (half[0] - abs(x + t * dx)) / width + 0.5
        b = (half[1] - abs(y + t * dy)) / width + 0.5
        return t, min(max(a, 0.0), 1.0) * min(max(b, 0.0), 1.0)
    if shape[i, 0] == CYLINDER:
        return _meet_cylinder(half, x, y, z, dx, dy, dz, footprint)
    enter, leave = _slabs(half, x, y, z, dx, dy, dz)
    if leave <= max(enter, 0.0) or enter <= 0.0:
        return NOTHING, 0.0
    # A chord grows from nothing at the silhouette, about twice as fast as the distance to it.
    return enter, min((leave - enter) / (2.0 * footprint * enter), 1.0)


@njit(cache=True, fastmath=True)
@no_type_check
def _slabs(half, x, y, z, dx, dy, dz):
    """Where a ray enters and leaves a box."""
    enter, leave = -NOTHING, NOTHING
    for h, p, d in ((half[0], x, dx), (half[1], y, dy), (half[2], z, dz)):
        d = d if abs(d) > 1e-9 else 1e-9
        a, b = (-h - p) / d, (h - p) / d
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    return enter, leave


@njit(cache=True, fastmath=True)
@no_type_check
def _meet_cylinder(half, x, y, z, dx, dy, dz, footprint):
    """Distance along a ray in a cylinder's axes, and the fraction of the ray that it covers."""
    radius, height = half[0], half[1]
    flat = max(dx * dx + dz * dz, 1e-12)
    along = -(x * dx + z * dz) / flat  # where the ray is nearest to the axis
    px, pz = x + along * dx, z + along * dz
    aside = sqrt(px * px + pz * pz)
    width = footprint * max(along, 0.0) if flat > 1e-9 else 0.0
    wide = radius + 0.5 * width
    if aside >= wide:
        return NOTHING, 0.0
    steep = dy if abs(dy) > 1e-9 else 1e-9
    a, b = (-height - y) / steep, (height - y) / steep
    above, below = min(a, b), max(a, b)
    reach = sqrt(max(radius * radius - aside * aside, 0.0) / flat)
    enter = max(along - reach, above)
    # Half a pixel wider, so that the chord at the silhouette is long: there `aside` says how much.
    wider = sqrt((wide * wide - aside * aside) / flat)
    chord = min(along + wider, below) - max(along - wider, above)
    if chord <= 0.0 or enter <= 0.0:
        return NOTHING, 0.0
    side = (radius - aside) / width + 0.5 if width > 0.0 else 1.0
    return enter, min(min(max(side, 0.0), 1.0), min(chord / (2.0 * footprint * enter), 1.0))


@njit(cache=True, fastmath=True)
@no_type_check
def _colour(surfaces, shape, i, ray, t, footprint):
    """Linear rgb of a surface at its intersection with a ray."""
    nx, ny, nz, u, v, x, y, facing = _surface_point(shape, i, ray, t)
    look = surfaces.look
    texture, width = int(look[i, 9]), footprint * t
    ink, accent = 0.0, 0.0
    if texture != TEXT:
        seen = width / max(facing, 0.25)
        ink, accent = paint(texture, u, v, seen, look[i, 10], int(look[i, 11]), look[i, 12])
    elif nz == -1.0:
        half_x, half_y, columns = shape[i, 4], shape[i, 5], int(look[i, 15])
        sheet = surfaces.pages[int(look[i, 13]), : int(look[i, 14]), :columns]
        across, down = 0.5 + 0.5 * x / half_x, 0.5 + 0.5 * y / half_y
        ink = letters(sheet, across, down, width * columns / (2.0 * half_x))
    normal = (
        shape[i, 7] * nx + shape[i, 10] * ny + shape[i, 13] * nz,
        shape[i, 8] * nx + shape[i, 11] * ny + shape[i, 14] * nz,
        shape[i, 9] * nx + shape[i, 12] * ny + shape[i, 15] * nz,
    )
    size = sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)  # not 1 if it is deformed
    normal = (normal[0] / size, normal[1] / size, normal[2] / size)
    place = (ray[0] + t * ray[3], ray[1] + t * ray[4], ray[2] + t * ray[5])
    ambient = surfaces.light[3]
    bright = ambient + (1.0 - ambient) * _sunlight(shape, surfaces.light, i, place, normal)
    a, b, c = bright * (1.0 - ink - accent), bright * ink, bright * accent
    return (
        a * look[i, 0] + b * look[i, 3] + c * look[i, 6],
        a * look[i, 1] + b * look[i, 4] + c * look[i, 7],
        a * look[i, 2] + b * look[i, 5] + c * look[i, 8],
    )


@njit(cache=True, fastmath=True)
@no_type_check
def _surface_point(shape, i, ray, t):
    """Normal in the surface's axes; texture coordinates; x, y in its axes; cosine to the ray."""
    x, y, z, dx, dy, dz = _within(shape, i, ray)
    x, y, z = x + t * dx, y + t * dy, z + t * dz
    nx, ny, nz, u, v = 0.0, 0.0, -1.0 if dz > 0 else 1.0, x, y
    if shape[i, 0] == BALL:
        radius = shape[i, 4]
        nx, ny, nz = x / radius, y / radius, z / radius
        u, v = radius * atan2(nx, -nz), radius * asin(min(max(ny, -1.0), 1.0))
    elif shape[i, 0] == CYLINDER:
        radius = sqrt(x * x + z * z)
        if shape[i, 5] - abs(y) <= shape[i, 4] - radius:
            ny, nz, v = (-1.0 if y < 0 else 1.0), 0.0, z
        else:
            nx, nz = x / max(radius, 1e-9), z / max(radius, 1e-9)
            u = shape[i, 4] * atan2(nx, -nz)
    elif shape[i, 0] == BOX:
        a, b, c = shape[i, 4] - abs(x), shape[i, 5] - abs(y), shape[i, 6] - abs(z)
        if c <= a and c <= b:
            nz = -1.0 if z < 0 else 1.0
        elif a <= b:
            nx, nz, u = (-1.0 if x < 0 else 1.0), 0.0, z
        else:
            ny, nz, v = (-1.0 if y < 0 else 1.0), 0.0, z
    return nx, ny, nz, u, v, x, y, abs(nx * dx + ny * dy + nz * dz)


@njit(cache=True, fastmath=True)
@no_type_check
def _sunlight(shape, light, i, place, normal):
    """Cosine towards the sun, times the fraction of the sun that is not occluded."""
    cosine = light[0] * normal[0] + light[1] * normal[1] + light[2] * normal[2]
    if cosine <= 0.0:
        return 0.0
    ray = (place[0], place[1], place[2], light[0], light[1], light[2])
    for k in range(len(shape)):
        if k != i and shape[k, 16] == 1.0:
            t, cover = _meet(shape, k, ray, PENUMBRA_RAD)
            if t > 1e-3:
                cosine *= 1.0 - cover
    return cosine
