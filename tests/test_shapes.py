"""The shape annotations are really checked while the tests run, not only written down."""

import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.core.rays import Rays

# jaxtyping raises its own error for functions and for dataclasses, naming the failed annotation.
WRONG = "type-check|Type-check"


def test_a_right_shape_passes():
    camera = Camera(4, 3, 5.0, 5.0, 2.0, 1.5)
    assert camera.direction(torch.zeros(7, 2)).shape == (7, 3)


def test_a_wrong_shape_is_refused_by_a_function():
    camera = Camera(4, 3, 5.0, 5.0, 2.0, 1.5)
    with pytest.raises(Exception, match=WRONG):
        camera.direction(torch.zeros(7, 3))


def test_a_wrong_dtype_is_refused_by_a_function():
    camera = Camera(4, 3, 5.0, 5.0, 2.0, 1.5)
    with pytest.raises(Exception, match=WRONG):
        camera.direction(torch.zeros(7, 2, dtype=torch.int64))


def test_axes_that_disagree_are_refused_by_a_struct():
    three, four = torch.zeros(3, 3), torch.zeros(4)
    assert len(Rays(three, three, torch.zeros(3), torch.zeros(3))) == 3
    with pytest.raises(Exception, match=WRONG):
        Rays(three, three, four, four)
