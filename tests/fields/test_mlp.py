import torch

from sharpfield.core.seed import generator
from sharpfield.fields.mlp import MLPField, MLPHead
from sharpfield.ops.encoding import frequencies


def made() -> torch.Generator:
    return generator(0, 0, "field test")


def test_golden_size():
    """Of each of NeRF's two networks."""
    field = MLPField(generator=made())
    for head in (field.coarse, field.fine):
        assert sum(p.numel() for p in head.parameters()) == 595_844


def test_it_is_the_network_of_the_paper():
    head = MLPHead(generator=made(), width=16)
    points, direction = torch.randn(5, 7, 3), torch.randn(5, 3)
    raw, hidden = head.density(points[..., :0], points)

    encoded = x = frequencies(points, 10)
    for index, layer in enumerate(head.trunk.layers):
        x = torch.cat([encoded, x], -1) if index == 5 else x  # the input again, after five layers
        x = torch.relu(layer(x))
    torch.testing.assert_close(hidden, x)
    torch.testing.assert_close(raw, head.to_density(x)[..., 0])

    toward = frequencies(direction, 4)[:, None].expand(-1, 7, -1)
    joined = torch.cat([head.first.of_sample, head.first.of_ray], 1)
    x = torch.cat([head.to_feature(x), toward], -1) @ joined.T + head.first.bias
    wanted = torch.sigmoid(head.last(torch.relu(x)))
    torch.testing.assert_close(head.colour(head.feature(hidden), direction), wanted)


def test_nothing_is_looked_up():
    field, time = MLPField(generator=made(), width=4, depth=2), torch.zeros(5)
    old, new = torch.randn(5, 7, 3), torch.randn(5, 2, 3)
    features = field.coarse_features(old, time)
    assert features.shape == (5, 7, 0)
    assert field.fine_features(features, old, new, time).shape == (5, 9, 0)


def test_every_parameter_learns():
    head = MLPHead(generator=made(), width=8, depth=4)
    points = torch.randn(20, 7, 3)
    raw, hidden = head.density(points[..., :0], points)
    (raw.sum() + head.colour(head.feature(hidden), torch.randn(20, 3)).sum()).backward()
    assert all(p.grad is not None and p.grad.any() for p in head.parameters())


def test_gradients():
    head = MLPHead(generator=made(), width=4, depth=2, position=2, direction=1).double()
    points = torch.randn(2, 3, 3, dtype=torch.float64, requires_grad=True)
    direction = torch.randn(2, 3, dtype=torch.float64, requires_grad=True)

    def light(points: torch.Tensor, direction: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        raw, hidden = head.density(points[..., :0], points)
        return raw, head.colour(head.feature(hidden), direction)

    assert torch.autograd.gradcheck(light, (points, direction))
