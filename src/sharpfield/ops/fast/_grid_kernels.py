# pyright: basic
"""Kernels of plane and line lookups: channels as vectors, gradients without races.

Vocabulary: the *taps* of a point along an axis are the two cells around it, their weights and the
weights' slopes (derivatives by the point). A tap outside the grid is moved to the nearest cell and
weighs nothing. `axes` names the axis along a plane's columns, along its rows and along the line.

A *band* is a share of a plane's rows. Each band adds its rows' gradients alone, walking over the
points in order, so sums do not depend on the number of threads; the gradient of a line is summed
per band, and the bands afterwards.
"""

from typing import NamedTuple

import numpy as np

from sharpfield.ops.fast._kernel import kernel, share
from sharpfield.ops.fast._lanes import load, prefetch, store, total

BANDS = 8
"""Shares of a plane's rows; a constant, so that results do not depend on the number of threads."""

STRIPE = 4
"""Neighbouring rows of one band: samples crowd around surfaces, and stripes spread the crowd."""

AHEAD = 8
"""Points between asking for a cache line and using it."""


class Taps(NamedTuple):
    """Taps of points along x, y and z, each `[n, 3, 2]`."""

    cells: np.ndarray
    weights: np.ndarray
    slopes: np.ndarray


class Volume(NamedTuple):
    """Three planes and three lines."""

    axes: np.ndarray
    """`[3, 3]`: of each pair."""
    planes: tuple[np.ndarray, np.ndarray, np.ndarray]
    lines: tuple[np.ndarray, np.ndarray, np.ndarray]
    lanes: tuple[int, ...]


@kernel
def locate(worker, workers, points, shape, taps):
    """Find the taps of points in a grid of `shape` cells along x, y and z."""
    for point in range(*share(worker, workers, points.shape[0])):
        for axis in range(3):
            last = shape[axis] - 1
            place = (points[point, axis] + 1.0) * 0.5 * last
            # Two cells outside, both taps are; not a number stays one, in the weights.
            place = -2.0 if place < -2.0 else last + 2.0 if place > last + 2.0 else place
            low = int(np.floor(place)) if place == place else 0
            past = place - low
            has_low, has_high = 0 <= low <= last, 0 <= low + 1 <= last
            taps.cells[point, axis, 0] = min(max(low, 0), last)
            taps.cells[point, axis, 1] = min(max(low + 1, 0), last)
            taps.weights[point, axis, 0] = 1.0 - past if has_low else 0.0
            taps.weights[point, axis, 1] = past if has_high else 0.0
            taps.slopes[point, axis, 0] = -0.5 * last if has_low else 0.0
            taps.slopes[point, axis, 1] = 0.5 * last if has_high else 0.0


@kernel
def _corners(cells, axes, plane):
    """Where the four taps of a plane begin."""
    columns, channels = plane.shape[1], plane.shape[2]
    left, right = cells[axes[0], 0], cells[axes[0], 1]
    top, bottom = cells[axes[1], 0] * columns, cells[axes[1], 1] * columns
    return (
        (top + left) * channels,
        (top + right) * channels,
        (bottom + left) * channels,
        (bottom + right) * channels,
    )


@kernel
def _ends(cells, axes, line):
    """Where the two taps of a line begin."""
    return cells[axes[2], 0] * line.shape[1], cells[axes[2], 1] * line.shape[1]


@kernel
def _products(columns, rows):
    """The weights of the four taps of a plane."""
    return rows[0] * columns[0], rows[0] * columns[1], rows[1] * columns[0], rows[1] * columns[1]


@kernel
def _fetch(cells, axes, plane, lanes):
    """Ask for the rows of a plane that a point needs."""
    for corner in _corners(cells, axes, plane):
        for channel in range(0, plane.shape[2], len(lanes)):
            prefetch(plane, corner + channel)


@kernel
def _on_plane(plane, corners, weights, channel, lanes):
    return (
        load(plane, corners[0] + channel, lanes) * weights[0]
        + load(plane, corners[1] + channel, lanes) * weights[1]
        + load(plane, corners[2] + channel, lanes) * weights[2]
        + load(plane, corners[3] + channel, lanes) * weights[3]
    )


@kernel
def _on_line(line, ends, weights, channel, lanes):
    return (
        load(line, ends[0] + channel, lanes) * weights[0]
        + load(line, ends[1] + channel, lanes) * weights[1]
    )


@kernel
def _gather_pair(taps, point, axes, tables, out, at, lanes):
    """Write plane times line at one point, from position `at` on."""
    plane, line = tables
    cells, weights = taps.cells[point], taps.weights[point]
    corners, ends = _corners(cells, axes, plane), _ends(cells, axes, line)
    shares, along = _products(weights[axes[0]], weights[axes[1]]), weights[axes[2]]
    for channel in range(0, plane.shape[2], len(lanes)):
        row = _on_plane(plane, corners, shares, channel, lanes)
        store(out, at + channel, row * _on_line(line, ends, along, channel, lanes))


@kernel
def gather(worker, workers, taps, volume, out):
    """Write the features of a worker's points into `out [n, f]`."""
    points, features = out.shape
    for point in range(*share(worker, workers, points)):
        ahead = taps.cells[min(point + AHEAD, points - 1)]
        at = point * features
        for pair in range(3):
            _fetch(ahead, volume.axes[pair], volume.planes[pair], volume.lanes)
        for pair in range(3):
            tables = (volume.planes[pair], volume.lines[pair])
            _gather_pair(taps, point, volume.axes[pair], tables, out, at, volume.lanes)
            at += tables[0].shape[2]


@kernel
def _is_in(row, band):
    return row // STRIPE % BANDS == band


@kernel
def _points_of_band(cells, axis, band, points):
    """Write the points that touch a row of the band into `points`; return how many."""
    count = 0
    for point in range(cells.shape[0]):
        points[count] = point
        count += _is_in(cells[point, axis, 0], band) or _is_in(cells[point, axis, 1], band)
    return count


@kernel
def _add(target, at, row, lanes):
    store(target, at, load(target, at, lanes) + row)


@kernel
def _scatter_point(band, taps, point, axes, pair, grad, at, lanes):
    """Add one point to the rows of a band; to the line too, if its first row is of the band."""
    plane, line, plane_grad, line_grad = pair
    cells, weights = taps.cells[point], taps.weights[point]
    corners, ends = _corners(cells, axes, plane), _ends(cells, axes, line)
    shares, along = _products(weights[axes[0]], weights[axes[1]]), weights[axes[2]]
    has_top, has_bottom = _is_in(cells[axes[1], 0], band), _is_in(cells[axes[1], 1], band)
    for channel in range(0, plane.shape[2], len(lanes)):
        arrived = load(grad, at + channel, lanes)
        to_plane = arrived * _on_line(line, ends, along, channel, lanes)
        if has_top:
            to_line = arrived * _on_plane(plane, corners, shares, channel, lanes)
            _add(line_grad, ends[0] + channel, to_line * along[0], lanes)
            _add(line_grad, ends[1] + channel, to_line * along[1], lanes)
            _add(plane_grad, corners[0] + channel, to_plane * shares[0], lanes)
            _add(plane_grad, corners[1] + channel, to_plane * shares[1], lanes)
        if has_bottom:
            _add(plane_grad, corners[2] + channel, to_plane * shares[2], lanes)
            _add(plane_grad, corners[3] + channel, to_plane * shares[3], lanes)


@kernel
def _scatter_band(band, taps, axes, pair, grad, first, lanes):
    """Add all points to the rows of a band."""
    points = np.empty(taps.cells.shape[0] + 1, np.intp)
    count = _points_of_band(taps.cells, axes[1], band, points)
    for index in range(count):
        ahead = taps.cells[points[min(index + AHEAD, count - 1)]]
        _fetch(ahead, axes, pair[0], lanes)
        _fetch(ahead, axes, pair[2], lanes)
        at = points[index] * grad.shape[1] + first
        _scatter_point(band, taps, points[index], axes, pair, grad, at, lanes)


@kernel
def scatter(worker, workers, taps, volume, gradients, grad):
    """Add the gradients of planes and lines, as far as they are in a worker's bands.

    Args:
        worker: Which one.
        workers: How many.
        taps: Of all points.
        volume: The planes and lines.
        gradients: Of the planes `[h, w, c]`, and of the lines per band `[BANDS, l, c]`.
        grad: The gradient of the features `[n, f]`.
    """
    for band in range(worker, BANDS, workers):
        first = 0
        for pair in range(3):
            plane, line = volume.planes[pair], volume.lines[pair]
            tables = (plane, line, gradients[0][pair], gradients[1][pair][band])
            _scatter_band(band, taps, volume.axes[pair], tables, grad, first, volume.lanes)
            first += plane.shape[2]


@kernel
def _slope_of_pair(taps, point, axes, tables, grad, at, lanes, out):
    """Add the gradient of one pair to that of a point."""
    plane, line = tables
    cells, weights, slopes = taps.cells[point], taps.weights[point], taps.slopes[point]
    columns, rows, along = weights[axes[0]], weights[axes[1]], weights[axes[2]]
    corners, ends = _corners(cells, axes, plane), _ends(cells, axes, line)
    shares = _products(columns, rows)
    by_column, by_row = _products(slopes[axes[0]], rows), _products(columns, slopes[axes[1]])
    for channel in range(0, plane.shape[2], len(lanes)):
        arrived = load(grad, at + channel, lanes)
        to_plane = arrived * _on_line(line, ends, along, channel, lanes)
        to_line = arrived * _on_plane(plane, corners, shares, channel, lanes)
        out[axes[0]] += total(to_plane * _on_plane(plane, corners, by_column, channel, lanes))
        out[axes[1]] += total(to_plane * _on_plane(plane, corners, by_row, channel, lanes))
        out[axes[2]] += total(to_line * _on_line(line, ends, slopes[axes[2]], channel, lanes))


@kernel
def slope(worker, workers, taps, volume, grad, out):
    """Add the gradients of a worker's points to `out [n, 3]`."""
    points, features = grad.shape
    for point in range(*share(worker, workers, points)):
        ahead = taps.cells[min(point + AHEAD, points - 1)]
        at = point * features
        for pair in range(3):
            _fetch(ahead, volume.axes[pair], volume.planes[pair], volume.lanes)
        for pair in range(3):
            axes, tables = volume.axes[pair], (volume.planes[pair], volume.lines[pair])
            _slope_of_pair(taps, point, axes, tables, grad, at, volume.lanes, out[point])
            at += tables[0].shape[2]
