import pytest
import torch

from sharpfield.metrics.image import relative_count_error

MEASURED = torch.tensor([[[3.0, 0.0], [1.0, 4.0]]])


def test_perfect_prediction_has_no_error():
    assert relative_count_error(MEASURED, MEASURED) == 0


def test_predicting_nothing_has_relative_error_one():
    assert relative_count_error(torch.zeros_like(MEASURED), MEASURED).item() == pytest.approx(1)


def test_errors_of_opposite_sign_do_not_cancel():
    off = MEASURED + torch.tensor([[[1.0, -1.0], [0.0, 0.0]]])
    assert relative_count_error(off, MEASURED).item() == pytest.approx(0.25)
