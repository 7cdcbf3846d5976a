"""Small networks: shapes, skips, seeds."""

import math

import pytest
import torch

from sharpfield.core.seed import generator
from sharpfield.ops.dense import Dense, FrameVectors, SplitLinear, linear


def parameters(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_linear_follows_the_default_rule_and_leaves_the_global_generator_alone() -> None:
    before = torch.get_rng_state()
    layer = linear(400, 300, generator=generator(0, 0, "a"))
    assert torch.equal(torch.get_rng_state(), before)
    bound = 1 / math.sqrt(400)
    assert 0.99 * bound < layer.weight.abs().max() <= bound
    assert 0.9 * bound < layer.bias.abs().max() <= bound
    assert abs(layer.weight.mean()) < 0.01 * bound
    torch.testing.assert_close(layer.weight.std().item(), bound / math.sqrt(3), rtol=0.01, atol=0)


def test_same_generator_same_network_other_stream_other_network() -> None:
    nets = [Dense([3, 8, 2], generator=generator(0, 0, s)) for s in ("a", "a", "b")]
    x = torch.ones(1, 3)
    assert torch.equal(nets[0](x), nets[1](x)) and not torch.equal(nets[0](x), nets[2](x))


def test_dense_is_its_layers_with_activations_between() -> None:
    net = Dense([3, 8, 8, 2], generator=generator(0, 0, "a"))
    x = torch.randn(5, 3, generator=generator(0, 0, "x"))
    hidden = torch.relu(net.layers[0](x))
    expected = net.layers[2](torch.relu(net.layers[1](hidden)))
    torch.testing.assert_close(net(x), expected)


def test_skip_feeds_the_input_again() -> None:
    net = Dense([3, 8, 8, 2], generator=generator(0, 0, "a"), skips=(2,))
    x = torch.randn(5, 3, generator=generator(0, 0, "x"))
    hidden = torch.relu(net.layers[1](torch.relu(net.layers[0](x))))
    torch.testing.assert_close(net(x), net.layers[2](torch.cat([x, hidden], -1)))


def test_published_parameter_counts() -> None:
    g = generator(0, 0, "a")
    trunk = Dense([63] + 8 * [256], generator=g, skips=(5,))
    assert parameters(trunk) == 63 * 256 + 6 * 256 * 256 + (256 + 63) * 256 + 8 * 256
    density = Dense([95, 64, 16], generator=g, bias=False)
    colour = Dense([42, 64, 64, 3], generator=g, bias=False)
    basis = Dense([96, 32], generator=g, bias=False)
    assert parameters(density) + parameters(colour) + parameters(basis) == 17_152
    density = Dense([127, 256, 129], generator=g, bias=False)
    colour = Dense([155, 256, 256, 3], generator=g, bias=False)
    assert parameters(density) + parameters(colour) + parameters(basis) == 174_592


@pytest.mark.parametrize("bias", [False, True])
def test_split_layer_equals_one_layer_on_joined_features(bias: bool) -> None:
    split = SplitLinear(4, 3, 5, generator=generator(0, 0, "a"), bias=bias)
    whole = linear(7, 5, generator=generator(0, 0, "a"), bias=bias)
    sample = torch.randn(2, 6, 4, generator=generator(0, 0, "s"))
    ray = torch.randn(2, 3, generator=generator(0, 0, "r"))
    joined = torch.cat([sample, ray[:, None].expand(2, 6, 3)], -1)
    torch.testing.assert_close(split(sample, ray), whole(joined))
    assert parameters(split) == parameters(whole)


def test_every_frame_starts_with_the_same_vector_and_learns_its_own() -> None:
    vectors = FrameVectors(3, 4)
    found = vectors(torch.tensor([[0, 2], [2, 2]]))
    assert found.shape == (2, 2, 4) and not found.any()
    found.sum().backward()
    assert vectors.vectors.grad is not None
    assert vectors.vectors.grad[:, 0].tolist() == [1, 0, 3]
