import torch

from sharpfield.core.measurements import EventPairs


def pairs(negative: list[float], positive: list[float]) -> EventPairs:
    count = len(negative)
    time = torch.linspace(0, 1, count)
    return EventPairs(
        xy=torch.zeros(count, 2),
        track=torch.zeros(count, dtype=torch.int64),
        start=time,
        end=time,
        negative=torch.tensor(negative),
        positive=torch.tensor(positive),
    )


def test_each_sign_counts_by_its_own_threshold():
    change = pairs([0.0, -1.0, -3.0], [2.0, 0.0, 1.0]).measured(0.25, 0.2)
    torch.testing.assert_close(change, torch.tensor([0.4, -0.25, -0.55]))


def test_thresholds_may_be_learned():
    threshold = torch.tensor(0.2, requires_grad=True)
    pairs([-1.0, 0.0], [0.0, 3.0]).measured(threshold, 0.2).sum().backward()
    assert threshold.grad is not None and threshold.grad.item() == -1


def test_a_mono_sensor_has_no_channels():
    seen = pairs([0.0, -1.0], [1.0, 0.0])
    assert seen.channel is None and seen[1:].channel is None
    assert EventPairs.cat([seen, seen]).channel is None
