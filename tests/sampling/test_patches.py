"""Patches: inside the border, evenly apart, of a few frames, and the same for the same step."""

import numpy as np
import pytest
import torch

from sharpfield.core.errors import OptionError
from sharpfield.sampling.pixels_and_pairs import PatchShape, PixelTable, draw_patches


def table(frames: int = 6, height: int = 40, width: int = 60) -> PixelTable:
    y, x = np.mgrid[:height, :width]
    image = np.stack([x, y, np.zeros_like(x)], -1).astype(np.uint8)
    images = np.stack([image + np.array([0, 0, i], np.uint8) for i in range(frames)])
    learned = np.arange(1, frames)
    times = np.zeros((frames, 2), np.float32)
    return PixelTable(images, 255.0, learned, np.zeros(frames, np.int64), times)


def test_patches_lie_on_a_grid_inside_the_border_and_show_its_pixels():
    shape = PatchShape(side=5, apart=(2, 3), border=4)
    seen = draw_patches(table(), 40, shape, frames=2, seed=0, step=3)
    assert seen.shape == (40, 5, 5)
    x, y = seen.xy.unbind(-1)
    assert x.min() >= 4.5 and x.max() <= 60 - 4.5
    assert y.min() >= 4.5 and y.max() <= 40 - 4.5
    apart = x.diff(dim=2)
    assert set(apart.unique().tolist()) == {2.0, 3.0}
    assert torch.equal(apart.amax((1, 2)), y.diff(dim=1).amin((1, 2)))
    assert torch.allclose(seen.value[..., 0] * 255, x - 0.5)
    assert torch.allclose(seen.value[..., 1] * 255, y - 0.5)
    assert torch.allclose(seen.value[..., 2] * 255, seen.frame.float())


def test_a_step_looks_at_so_many_frames_and_an_epoch_at_all():
    shape = PatchShape(side=1, apart=(1, 1), border=0)
    frames = [draw_patches(table(), 12, shape, frames=1, seed=0, step=s).frame for s in range(5)]
    assert all(len(one.unique()) == 1 for one in frames)
    assert sorted(int(one[0, 0, 0]) for one in frames) == [1, 2, 3, 4, 5]
    two = draw_patches(table(), 12, shape, frames=2, seed=0, step=0).frame
    assert [int((two == one).sum()) for one in two.unique()] == [6, 6]


def test_draws_depend_on_seed_and_step_alone():
    shape = PatchShape(side=2, border=0)
    one, same, other, seed = (
        draw_patches(table(), 9, shape, frames=1, seed=seed, step=step).xy
        for seed, step in ((0, 7), (0, 7), (0, 8), (1, 7))
    )
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
    assert not torch.equal(one, seed)


def test_distances_shrink_to_what_fits():
    shape = PatchShape(side=8, apart=(1, 8), border=2)
    seen = draw_patches(table(height=20), 50, shape, frames=1, seed=0, step=0)
    assert seen.xy[..., 1].max() <= 18


def test_patches_larger_than_images_are_refused_in_words():
    with pytest.raises(OptionError, match="images are too small for such patches"):
        draw_patches(table(), 3, PatchShape(side=50, border=0), frames=1, seed=0, step=0)
