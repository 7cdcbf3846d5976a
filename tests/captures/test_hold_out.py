import numpy as np
import pytest

from sharpfield.captures.splits import split_by_rule
from sharpfield.core.errors import CaptureError, OptionError


@pytest.mark.parametrize(
    ("rule", "test"),
    [
        ("every:8", [0, 8, 16]),
        ("train:8", [1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14, 15, 17]),
        ("last:5", [13, 14, 15, 16, 17]),
        ("none", []),
    ],
)
def test_the_rules(rule, test):
    split = split_by_rule(18, rule)
    np.testing.assert_array_equal(split.test, test)
    np.testing.assert_array_equal(np.sort(np.concatenate([split.train, split.test])), range(18))


@pytest.mark.parametrize("rule", ["every", "every:0", "first:3", "last:-1", "every:8 "])
def test_a_rule_that_cannot_be_read(rule):
    with pytest.raises(OptionError, match="write every:8, train:5, last:5 or none"):
        split_by_rule(18, rule)


def test_something_must_be_left():
    with pytest.raises(CaptureError, match="no training frame is left") as caught:
        split_by_rule(4, "last:5")
    assert "4 frames" in str(caught.value)
