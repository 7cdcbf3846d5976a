# pyright: basic
"""Projecting Gaussians into views, listing them in tiles, and the way back.

The numbers of a splat are those of `_splat_blend`. With `W` the camera-from-world rotation, `J` the
slope of the projection at the mean and `L` the Gaussian's axes times its scales, the spread of a
splat is `A A^T` plus a constant, `A = J W L`.
"""

import math

import numpy as np

from sharpfield.ops.fast._kernel import kernel, share
from sharpfield.ops.fast._splat_blend import GEOMETRY, TILE
from sharpfield.ops.rasterizer import FAINTEST, NEAR, WIDEN

CHUNK = 512
"""Gaussians whose gradients for the poses are added up on their own; a constant, so that sums do
not depend on the number of threads."""

FLOOR = np.float32(1e-6)
"""Least determinant of a spread before widening, as in the definition."""

ONE, TWO, HALF = np.float32(1), np.float32(2), np.float32(0.5)
WIDER = np.float32(WIDEN)  # compiled in: whoever changes `WIDEN` must touch this file, too


@kernel
def _axes(quaternion, scale, axes):
    """Fill the rotation `axes[0]` and its columns times the scales `axes[1]`; gives 1 / length."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    inverse = ONE / max(np.float32(math.sqrt(w * w + x * x + y * y + z * z)), np.float32(1e-12))
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    turn = axes[0]
    turn[0, 0] = ONE - TWO * (y * y + z * z)
    turn[0, 1] = TWO * (x * y - w * z)
    turn[0, 2] = TWO * (x * z + w * y)
    turn[1, 0] = TWO * (x * y + w * z)
    turn[1, 1] = ONE - TWO * (x * x + z * z)
    turn[1, 2] = TWO * (y * z - w * x)
    turn[2, 0] = TWO * (x * z - w * y)
    turn[2, 1] = TWO * (y * z + w * x)
    turn[2, 2] = ONE - TWO * (x * x + y * y)
    for i in range(3):
        for j in range(3):
            axes[1, i, j] = turn[i, j] * scale[j]
    return inverse


@kernel
def _seen(mean, pose):
    """A mean in camera axes."""
    dx, dy, dz = mean[0] - pose[0, 3], mean[1] - pose[1, 3], mean[2] - pose[2, 3]
    return (
        pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz,
        pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz,
        pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz,
    )


@kernel
def _clamp(value, most):
    return min(max(value, -most), most)


@kernel
def _flatten(pose, lens, seen, axes, flat):
    """Fill `flat[0]` with J W and `flat[1]` with A."""
    x, y, z = seen
    over = ONE / z
    side_x, side_y = _clamp(x * over, lens[2]), _clamp(y * over, lens[3])
    for j in range(3):
        flat[0, 0, j] = lens[0] * over * (pose[j, 0] - side_x * pose[j, 2])
        flat[0, 1, j] = lens[1] * over * (pose[j, 1] - side_y * pose[j, 2])
    for i in range(2):
        for j in range(3):
            flat[1, i, j] = (
                flat[0, i, 0] * axes[1, 0, j]
                + flat[0, i, 1] * axes[1, 1, j]
                + flat[0, i, 2] * axes[1, 2, j]
            )


@kernel
def _spread(flat):
    """Elements xx, xy, yy of the spread before widening."""
    a = flat[1]
    return (
        a[0, 0] * a[0, 0] + a[0, 1] * a[0, 1] + a[0, 2] * a[0, 2],
        a[0, 0] * a[1, 0] + a[0, 1] * a[1, 1] + a[0, 2] * a[1, 2],
        a[1, 0] * a[1, 0] + a[1, 1] * a[1, 1] + a[1, 2] * a[1, 2],
    )


@kernel
def project(worker, workers, gaussians, colours, shift, poses, lens, out):
    """Fill the splats of all views, and the tiles each can reach: first and end across, down."""
    means, quaternions, scales, opacities = gaussians
    numbers, middles, antialiased = lens
    splats, reach = out
    views, count, channels = colours.shape
    axes, flat = np.empty((2, 3, 3), np.float32), np.empty((2, 2, 3), np.float32)
    for g in range(*share(worker, workers, count)):
        _axes(quaternions[g], scales[g], axes)
        for view in range(views):
            at = view * count + g
            reach[at] = 0
            x, y, z = _seen(means[g], poses[view])
            splat = splats[at]
            splat[5] = 0.0
            if z <= NEAR:
                continue
            _flatten(poses[view], numbers, (x, y, z), axes, flat)
            xx, xy, yy = _spread(flat)
            before = max(xx * yy - xy * xy, FLOOR)
            xx, yy = xx + WIDER, yy + WIDER
            determinant = xx * yy - xy * xy
            opacity = opacities[g]
            if antialiased:
                opacity *= np.float32(math.sqrt(before / determinant))
            if not opacity > FAINTEST:
                continue
            # Where the opacity has fallen to the faintest that is drawn.
            radius = np.float32(math.sqrt(2 * math.log(opacity / FAINTEST)))
            across = radius * np.float32(math.sqrt(xx))
            down = radius * np.float32(math.sqrt(yy))
            splat[0] = numbers[0] * x / z + middles[view, 0] + shift[view, g, 0]
            splat[1] = numbers[1] * y / z + middles[view, 1] + shift[view, g, 1]
            splat[2], splat[3], splat[4] = yy / determinant, -xy / determinant, xx / determinant
            splat[5], splat[6] = opacity, down
            for k in range(channels):
                splat[GEOMETRY + k] = colours[view, g, k]
            splat[GEOMETRY + channels] = z
            _tiles(splat[0], across, numbers[4], reach[at, 0:2])
            _tiles(splat[1], down, numbers[5], reach[at, 2:4])
            if reach[at, 0] >= reach[at, 1] or reach[at, 2] >= reach[at, 3]:
                reach[at] = 0


@kernel
def _tiles(centre, half, size, between):
    """First and end of the tiles that hold a pixel within `half` of a centre."""
    first = max(centre - half - HALF, np.float32(0))
    last = min(centre + half - HALF, size - ONE)
    if first > last:
        between[0] = between[1] = 0
        return
    between[0] = int(np.ceil(first)) // TILE
    between[1] = int(np.floor(last)) // TILE + 1


@kernel
def list_touches(worker, workers, splats, reach, slots, tiles_of_view, starts, touches):
    """Fill `starts` with where the touches of each tile of each view begin, and the touches.

    A view is one worker's. Its touches keep their places among all touches, sorted by tile and,
    within a tile, by depth.
    """
    across, down = tiles_of_view
    tiles = across * down
    views = (len(starts) - 1) // tiles
    count = len(reach) // views
    order, other = np.empty(count, np.int32), np.empty(count, np.int32)
    for view in range(worker, views, workers):
        base = view * count
        seen = 0
        for g in range(count):
            if reach[base + g, 1] > reach[base + g, 0]:
                order[seen] = g
                seen += 1
        _sort_by_depth(splats[base : base + count, -1], order, other, seen)
        fill_from = np.zeros(tiles + 1, np.int64)
        for i in range(seen):
            box = reach[base + order[i]]
            for y in range(box[2], box[3]):
                for x in range(box[0], box[1]):
                    fill_from[y * across + x + 1] += 1
        fill_from[0] = slots[base]
        for tile in range(tiles):
            fill_from[tile + 1] += fill_from[tile]
            starts[view * tiles + tile + 1] = fill_from[tile + 1]
        for i in range(seen):
            splat = base + order[i]
            box, slot = reach[splat], slots[splat]
            for y in range(box[2], box[3]):
                for x in range(box[0], box[1]):
                    place = fill_from[y * across + x]
                    touches[place, 0], touches[place, 1] = splat, slot
                    fill_from[y * across + x] = place + 1
                    slot += 1


@kernel
def _sort_by_depth(depth, order, other, seen):
    """Sort the first numbers in `order` by their depth; equal depths keep their order.

    Positive float32 numbers are in the order of their bits: three rounds of eleven bits.
    """
    keys = np.empty(seen, np.float32)
    for i in range(seen):
        keys[i] = depth[order[i]]
    bits, moved = keys.view(np.uint32), np.empty(seen, np.uint32)
    for shift in (0, 11, 22):
        begins = np.zeros(2049, np.int64)
        for i in range(seen):
            begins[((bits[i] >> shift) & 2047) + 1] += 1
        for digit in range(2048):
            begins[digit + 1] += begins[digit]
        for i in range(seen):
            digit = (bits[i] >> shift) & 2047
            moved[begins[digit]], other[begins[digit]] = bits[i], order[i]
            begins[digit] += 1
        bits[:], order[:seen] = moved, other[:seen]


@kernel
def project_back(worker, workers, gaussians, poses, lens, touched, out, of_poses):
    """Gradients of the Gaussians, of their colours and shifts, and of the poses by chunks."""
    slots, splats, touch_sums = touched
    means, quaternions, scales, opacities = gaussians
    of_means, of_quaternions, of_scales, of_opacities, of_colours, of_shift = out
    views, count, channels = of_colours.shape
    axes, flat = np.empty((2, 3, 3), np.float32), np.empty((2, 2, 3), np.float32)
    of_axes, of_seen = np.empty((3, 3), np.float32), np.empty(3, np.float32)
    total = np.empty(6 + channels + 1, np.float32)
    for chunk in range(*share(worker, workers, len(of_poses))):
        for g in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
            of_means[g] = 0.0
            of_opacities[g] = 0.0
            of_axes[:] = 0.0
            inverse = _axes(quaternions[g], scales[g], axes)
            for view in range(views):
                at = view * count + g
                _add_touches(touch_sums, slots[at], slots[at + 1], total)
                of_shift[view, g, 0], of_shift[view, g, 1] = total[0], total[1]
                for k in range(channels):
                    of_colours[view, g, k] = total[6 + k]
                if slots[at] == slots[at + 1]:
                    continue
                seen = _seen(means[g], poses[view])
                _flatten(poses[view], lens[0], seen, axes, flat)
                # The opacity's own share, then what widening took from it.
                of_opacities[g] += total[5] * splats[at, 5] / opacities[g]
                of_pose = of_poses[chunk, view].reshape(3, 4)
                _spread_back(total, splats[at], lens[2], flat)
                _flatten_back(flat, axes, (poses[view], of_pose), lens[0], seen, of_axes, of_seen)
                of_seen[2] += total[6 + channels]
                _seen_back(total, of_seen, means[g], lens[0], seen, (poses[view], of_pose))
                for i in range(3):
                    of_means[g, i] += (
                        poses[view, i, 0] * of_seen[0]
                        + poses[view, i, 1] * of_seen[1]
                        + poses[view, i, 2] * of_seen[2]
                    )
            _axes_back(
                quaternions[g], inverse, scales[g], axes, of_axes, of_quaternions[g], of_scales[g]
            )


@kernel
def _add_touches(touch_sums, first, last, total):
    total[:] = 0.0
    for slot in range(first, last):
        for k in range(len(total)):
            total[k] += touch_sums[slot, k]


@kernel
def _spread_back(total, splat, antialiased, flat):
    """Replace `flat[1]`, A, by its gradient."""
    a, b, c = splat[2], splat[3], splat[4]
    ga, gb, gc = total[2], total[3], total[4]
    # Of the widened spread S: -C G C for the conic C, with half of gb on each side.
    xx = -(a * a * ga + a * b * gb + b * b * gc)
    xy = -(a * b * ga + HALF * (a * c + b * b) * gb + b * c * gc)
    yy = -(b * b * ga + b * c * gb + c * c * gc)
    if antialiased:
        before = _spread(flat)
        determinant = before[0] * before[2] - before[1] * before[1]
        half = HALF * total[5] * splat[5]  # half the gradient of the logarithm of the opacity
        if determinant > FLOOR:
            over = half / determinant
            xx += over * before[2]
            xy -= over * before[1]
            yy += over * before[0]
        xx -= half * a
        xy -= half * b
        yy -= half * c
    for j in range(3):
        x, y = flat[1, 0, j], flat[1, 1, j]
        flat[1, 0, j] = TWO * (xx * x + xy * y)
        flat[1, 1, j] = TWO * (xy * x + yy * y)


@kernel
def _flatten_back(flat, axes, place, lens, seen, of_axes, of_seen):
    """From the gradient of A = J W L to those of L, of W (in the pose) and of the seen mean."""
    pose, of_pose = place
    x, y, z = seen
    over = ONE / z
    side_x, side_y = x * over, y * over
    most_x, most_y = _clamp(side_x, lens[2]), _clamp(side_y, lens[3])
    slope_x = slope_y = fall_x = fall_y = np.float32(0)
    for j in range(3):
        gx = gy = np.float32(0)  # gradient of (J W)[0, j] and [1, j]
        for k in range(3):
            gx += flat[1, 0, k] * axes[1, j, k]
            gy += flat[1, 1, k] * axes[1, j, k]
            of_axes[j, k] += flat[0, 0, j] * flat[1, 0, k] + flat[0, 1, j] * flat[1, 1, k]
        fx, fy = lens[0] * over, lens[1] * over
        of_pose[j, 0] += gx * fx
        of_pose[j, 1] += gy * fy
        of_pose[j, 2] -= gx * fx * most_x + gy * fy * most_y
        slope_x -= gx * fx * pose[j, 2]
        slope_y -= gy * fy * pose[j, 2]
        fall_x -= gx * flat[0, 0, j] * over
        fall_y -= gy * flat[0, 1, j] * over
    of_seen[0] = of_seen[1] = np.float32(0)
    of_seen[2] = fall_x + fall_y
    if side_x == most_x:
        of_seen[0] += slope_x * over
        of_seen[2] -= slope_x * side_x * over
    if side_y == most_y:
        of_seen[1] += slope_y * over
        of_seen[2] -= slope_y * side_y * over


@kernel
def _seen_back(total, of_seen, mean, lens, seen, place):
    """Add what the centre asks of the seen mean, and what that asks of the pose."""
    pose, of_pose = place
    x, y, z = seen
    gx, gy = total[0] * lens[0] / z, total[1] * lens[1] / z
    of_seen[0] += gx
    of_seen[1] += gy
    of_seen[2] -= (gx * x + gy * y) / z
    for i in range(3):
        offset = mean[i] - pose[i, 3]
        for j in range(3):
            of_pose[i, j] += offset * of_seen[j]
            of_pose[i, 3] -= pose[i, j] * of_seen[j]


@kernel
def _axes_back(quaternion, inverse, scale, axes, of_axes, of_quaternion, of_scale):
    """From the gradient of L to those of the scales and of the quaternion."""
    turn = axes[0]
    for j in range(3):
        of_scale[j] = (
            of_axes[0, j] * turn[0, j] + of_axes[1, j] * turn[1, j] + of_axes[2, j] * turn[2, j]
        )
        for i in range(3):
            of_axes[i, j] *= scale[j]
    g = of_axes
    w, x = quaternion[0] * inverse, quaternion[1] * inverse
    y, z = quaternion[2] * inverse, quaternion[3] * inverse
    gw = TWO * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
    gx = TWO * (
        y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) + w * (g[2, 1] - g[1, 2])
    ) - np.float32(4) * x * (g[1, 1] + g[2, 2])
    gy = TWO * (
        x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) + w * (g[0, 2] - g[2, 0])
    ) - np.float32(4) * y * (g[0, 0] + g[2, 2])
    gz = TWO * (
        x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) + w * (g[1, 0] - g[0, 1])
    ) - np.float32(4) * z * (g[0, 0] + g[1, 1])
    along = gw * w + gx * x + gy * y + gz * z
    of_quaternion[0] = (gw - along * w) * inverse
    of_quaternion[1] = (gx - along * x) * inverse
    of_quaternion[2] = (gy - along * y) * inverse
    of_quaternion[3] = (gz - along * z) * inverse
