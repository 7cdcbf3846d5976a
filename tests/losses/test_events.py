import pytest
import torch

from sharpfield.core.errors import ShapeError
from sharpfield.losses.events import BAYER_WEIGHTS, contrast_error, silence_error


def test_nothing_is_lost_where_they_agree():
    change = torch.randn(9)
    assert contrast_error(change[:, None], change) == 0


def test_equal_weights_are_no_weights():
    predicted, measured, channel = torch.randn(9, 1), torch.randn(9), torch.arange(9) % 3
    torch.testing.assert_close(
        contrast_error(predicted, measured, channel=channel, weights=(0.3, 0.3, 0.3)),
        contrast_error(predicted, measured),
    )


def test_it_is_the_weighted_mean_written_as_a_loop():
    predicted, measured = torch.randn(9, 1), torch.randn(9)
    channel = torch.randint(3, (9,))
    above = below = 0.0
    for i in range(9):
        weight = (0.4, 0.2, 0.4)[channel[i]]
        above += weight * (predicted[i, 0] - measured[i]).item() ** 2
        below += weight
    found = contrast_error(predicted, measured, channel=channel, weights=BAYER_WEIGHTS)
    assert found.item() == pytest.approx(above / below, rel=1e-5)


def test_weights_weigh_nothing_if_there_is_one_colour_only():
    predicted, measured, green = torch.randn(9, 1), torch.randn(9), torch.ones(9, dtype=torch.int64)
    torch.testing.assert_close(
        contrast_error(predicted, measured, channel=green, weights=BAYER_WEIGHTS),
        contrast_error(predicted, measured),
    )


def test_the_published_example():
    predicted = torch.tensor([[0.25001 / 0.20001]], dtype=torch.float64).log()
    loss = contrast_error(predicted, torch.tensor([0.2], dtype=torch.float64))
    assert loss.item() == pytest.approx(5.35e-4, abs=5e-7)


def test_silence_allows_less_than_a_threshold_of_either_sign():
    change = torch.tensor([-0.3, -0.1, 0.0, 0.15, 0.25])[:, None]
    negative, positive = torch.full((5,), 0.2), torch.full((5,), 0.1)
    expected = (0.1**2 + 0 + 0 + 0.05**2 + 0.15**2) / 5
    assert silence_error(change, negative, positive).item() == pytest.approx(expected, rel=1e-5)


def test_gradients():
    predicted = torch.randn(6, 1, dtype=torch.float64, requires_grad=True)
    measured, channel = torch.randn(6, dtype=torch.float64), torch.arange(6) % 3
    assert torch.autograd.gradcheck(
        lambda x: contrast_error(x, measured, channel=channel, weights=BAYER_WEIGHTS), predicted
    )
    threshold = torch.full((6,), 0.2, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: silence_error(x, threshold, threshold), predicted)


def test_gradients_reach_learned_thresholds():
    threshold = torch.full((3,), 0.2, requires_grad=True)
    silence_error(torch.ones(3, 1), threshold, threshold).backward()
    assert threshold.grad is not None and (threshold.grad < 0).all()


def test_weights_without_channels_are_refused():
    with pytest.raises(ShapeError) as wrong:
        contrast_error(torch.zeros(2, 1), torch.zeros(2), weights=BAYER_WEIGHTS)
    assert str(wrong.value) == (
        "ShapeError: colour weights need the colour of each pair\n"
        "  got    channel=None\n"
        "  do     leave `weights` out for a mono sensor"
    )
