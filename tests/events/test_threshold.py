import pytest
import torch

from sharpfield.core.errors import OptionError
from sharpfield.events.threshold import FixedThresholds, LearnedThresholds, Thresholds
from tests.formation.toy import pairs


@pytest.mark.parametrize("kind", [FixedThresholds, LearnedThresholds])
def test_they_give_one_of_each_sign_for_every_pair(kind):
    thresholds = kind(0.2, 0.3)
    assert isinstance(thresholds, Thresholds)
    negative, positive = thresholds(pairs())
    torch.testing.assert_close(negative, torch.full((7,), 0.2))
    torch.testing.assert_close(positive, torch.full((7,), 0.3))


def test_measured_change_of_each_sign():
    seen = pairs()
    change = seen.measured(*FixedThresholds(0.2, 0.3)(seen))
    expected = [0.3 if up else -0.2 for up in (seen.positive > 0).tolist()]
    torch.testing.assert_close(change, torch.tensor(expected))


def test_learned_ones_find_the_true_ones():
    seen = pairs(40)
    truth = seen.measured(*FixedThresholds(0.15, 0.27)(seen))
    thresholds = LearnedThresholds(0.2, 0.2)
    optimizer = torch.optim.Adam(thresholds.parameters(), lr=0.05)
    for _ in range(200):
        optimizer.zero_grad()
        (seen.measured(*thresholds(seen)) - truth).square().mean().backward()
        optimizer.step()
    negative, positive = thresholds(seen)
    assert negative[0].item() == pytest.approx(0.15, abs=1e-3)
    assert positive[0].item() == pytest.approx(0.27, abs=1e-3)


def test_learned_ones_stay_positive():
    thresholds = LearnedThresholds(0.2, 0.2)
    with torch.no_grad():
        thresholds.log_factor -= 30
    assert all((part > 0).all() for part in thresholds(pairs()))


def test_a_pixel_has_its_own_factor():
    seen = pairs()
    thresholds = LearnedThresholds(0.2, 0.2, pixels=(16, 12))
    assert thresholds.log_pixel is not None
    x, y = (int(v) for v in seen.xy[3])
    with torch.no_grad():
        thresholds.log_pixel[1, y, x] = torch.tensor(2.0).log()
    negative, positive = thresholds(seen)
    assert positive[3].item() == pytest.approx(0.4) and negative[3].item() == pytest.approx(0.2)
    positive.sum().backward()
    assert (thresholds.log_pixel.grad != 0).sum() == len({tuple(v) for v in seen.xy.int().tolist()})


def test_a_rectified_pixel_beyond_the_border_takes_the_nearest():
    thresholds = LearnedThresholds(0.2, 0.2, pixels=(16, 12))
    seen = pairs(1)
    outside = type(seen)(**{**vars(seen), "xy": torch.tensor([[-3.0, 99.0]])})
    assert thresholds(outside)[0].item() == pytest.approx(0.2)


def test_the_prior_counts_standard_deviations():
    thresholds = LearnedThresholds(0.2, 0.2, spread=0.1, pixels=(4, 4))
    assert thresholds.prior() == 0
    with torch.no_grad():
        thresholds.log_factor += torch.tensor([0.1, -0.2])
    assert thresholds.prior().item() == pytest.approx((1 + 4) / 2, rel=1e-5)


@pytest.mark.parametrize("kind", [FixedThresholds, LearnedThresholds])
def test_a_threshold_that_is_not_positive_is_refused(kind):
    with pytest.raises(OptionError) as wrong:
        kind(-0.2, 0.2)
    assert str(wrong.value) == (
        "OptionError: contrast thresholds must be positive\n"
        "  got    negative -0.2, positive 0.2\n"
        "  do     give both as sizes; the sign of an event is its polarity"
    )
