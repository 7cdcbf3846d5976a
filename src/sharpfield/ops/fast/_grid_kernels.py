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
from sharpfield.ops.fast._lanes import load, prefetch, store, total, zeros
from sharpfield.ops.grid import PAIRS

BANDS = 8
"""Shares of a plane's rows; a constant, so that results do not depend on the number of threads."""

STRIPE = 8
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

    planes: tuple[np.ndarray, ...]
    lines: tuple[np.ndarray, ...]
    lanes: tuple[int, ...]


class Gradients(NamedTuple):
    """Of a volume; of its lines one per band, `[BANDS, l, c]`, still to be summed."""

    planes: tuple[np.ndarray, ...]
    lines: tuple[np.ndarray, ...]


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
def _corners(cells, point, axes, plane):
    """Where the four taps of a plane begin."""
    columns, channels = plane.shape[1], plane.shape[2]
    left, right = cells[point, axes[0], 0], cells[point, axes[0], 1]
    top, bottom = cells[point, axes[1], 0] * columns, cells[point, axes[1], 1] * columns
    return (
        (top + left) * channels,
        (top + right) * channels,
        (bottom + left) * channels,
        (bottom + right) * channels,
    )


@kernel
def _ends(cells, point, axes, line):
    """Where the two taps of a line begin."""
    channels = line.shape[1]
    return cells[point, axes[2], 0] * channels, cells[point, axes[2], 1] * channels


@kernel
def _both(weights, point, axis):
    return weights[point, axis, 0], weights[point, axis, 1]


@kernel
def _products(columns, rows):
    """The weights of the four taps of a plane."""
    return rows[0] * columns[0], rows[0] * columns[1], rows[1] * columns[0], rows[1] * columns[1]


@kernel
def _fetch(cells, point, axes, plane, lanes):
    """Ask for the rows of a plane that a point needs."""
    corners = _corners(cells, point, axes, plane)
    for channel in range(0, plane.shape[2], len(lanes)):
        prefetch(plane, corners[0] + channel)
        prefetch(plane, corners[1] + channel)
        prefetch(plane, corners[2] + channel)
        prefetch(plane, corners[3] + channel)


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
def _gather_pair(points, taps, axes, tables, out, first, lanes):
    """Write plane times line, at points from `points[0]` to `points[1]`."""
    cells, weights = taps.cells, taps.weights
    plane, line = tables
    for point in range(points[0], points[1]):
        _fetch(cells, min(point + AHEAD, points[1] - 1), axes, plane, lanes)
        corners, ends = _corners(cells, point, axes, plane), _ends(cells, point, axes, line)
        columns, rows = _both(weights, point, axes[0]), _both(weights, point, axes[1])
        shares, along = _products(columns, rows), _both(weights, point, axes[2])
        at = point * out.shape[1] + first
        for channel in range(0, plane.shape[2], len(lanes)):
            row = _on_plane(plane, corners, shares, channel, lanes)
            store(out, at + channel, row * _on_line(line, ends, along, channel, lanes))


@kernel
def gather(worker, workers, taps, volume, out):
    """Write the features of a worker's points into `out [n, f]`."""
    points, first = share(worker, workers, out.shape[0]), 0
    for pair in range(3):
        tables = (volume.planes[pair], volume.lines[pair])
        _gather_pair(points, taps, PAIRS[pair], tables, out, first, volume.lanes)
        first += tables[0].shape[2]


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
def _scatter_pair(band, taps, axes, tables, gradients, grad, first, lanes):
    """Add to the rows of a band; to the line too, where a point's first row is of the band."""
    cells, weights = taps.cells, taps.weights
    plane, line = tables
    plane_grad, line_grad = gradients
    points = np.empty(cells.shape[0] + 1, np.intp)
    count = _points_of_band(cells, axes[1], band, points)
    for index in range(count):
        point, ahead = points[index], points[min(index + AHEAD, count - 1)]
        _fetch(cells, ahead, axes, plane, lanes)
        _fetch(cells, ahead, axes, plane_grad, lanes)
        corners, ends = _corners(cells, point, axes, plane), _ends(cells, point, axes, line)
        columns, rows = _both(weights, point, axes[0]), _both(weights, point, axes[1])
        shares, along = _products(columns, rows), _both(weights, point, axes[2])
        has_top = _is_in(cells[point, axes[1], 0], band)
        has_bottom = _is_in(cells[point, axes[1], 1], band)
        at = point * grad.shape[1] + first
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
def scatter(worker, workers, taps, volume, gradients, grad):
    """Add what `grad [n, f]` says about planes and lines, as far as it is in a worker's bands."""
    for band in range(worker, BANDS, workers):
        first = 0
        for pair in range(3):
            tables = (volume.planes[pair], volume.lines[pair])
            targets = (gradients.planes[pair], gradients.lines[pair][band])
            _scatter_pair(band, taps, PAIRS[pair], tables, targets, grad, first, volume.lanes)
            first += tables[0].shape[2]


@kernel
def _slope_of_pair(points, taps, axes, tables, grad, first, lanes, out):
    """Add the gradient of one pair to that of points from `points[0]` to `points[1]`."""
    cells, weights, slopes = taps.cells, taps.weights, taps.slopes
    plane, line = tables
    for point in range(points[0], points[1]):
        _fetch(cells, min(point + AHEAD, points[1] - 1), axes, plane, lanes)
        corners, ends = _corners(cells, point, axes, plane), _ends(cells, point, axes, line)
        columns, rows = _both(weights, point, axes[0]), _both(weights, point, axes[1])
        shares, along = _products(columns, rows), _both(weights, point, axes[2])
        by_column = _products(_both(slopes, point, axes[0]), rows)
        by_row = _products(columns, _both(slopes, point, axes[1]))
        by_along = _both(slopes, point, axes[2])
        of_column, of_row, of_along = zeros(plane, lanes), zeros(plane, lanes), zeros(plane, lanes)
        at = point * grad.shape[1] + first
        for channel in range(0, plane.shape[2], len(lanes)):
            arrived = load(grad, at + channel, lanes)
            to_plane = arrived * _on_line(line, ends, along, channel, lanes)
            to_line = arrived * _on_plane(plane, corners, shares, channel, lanes)
            of_column += to_plane * _on_plane(plane, corners, by_column, channel, lanes)
            of_row += to_plane * _on_plane(plane, corners, by_row, channel, lanes)
            of_along += to_line * _on_line(line, ends, by_along, channel, lanes)
        out[point, axes[0]] += total(of_column)
        out[point, axes[1]] += total(of_row)
        out[point, axes[2]] += total(of_along)


@kernel
def slope(worker, workers, taps, volume, grad, out):
    """Add the gradients of a worker's points to `out [n, 3]`."""
    points, first = share(worker, workers, out.shape[0]), 0
    for pair in range(3):
        tables = (volume.planes[pair], volume.lines[pair])
        _slope_of_pair(points, taps, PAIRS[pair], tables, grad, first, volume.lanes, out)
        first += tables[0].shape[2]
