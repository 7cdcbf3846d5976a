from dataclasses import replace

import pytest
import torch
from torch.nn.functional import leaky_relu, linear, normalize

from sharpfield.core.rays import Samples
from sharpfield.core.seed import generator
from sharpfield.formation import adaptive
from sharpfield.formation.adaptive import AdaptiveWeights
from sharpfield.ops.encoding import frequencies

INTEGRATIONS = ["samples", "channels"]


def network(rays: int = 4, **options) -> AdaptiveWeights:
    made = generator(0, 0, "adaptive")
    return AdaptiveWeights(rays, features=6, code=5, generator=made, **options).double()


def samples(b: int = 3, k: int = 4, s: int = 7, f: int = 6) -> Samples:
    made = generator(0, 0, "samples")
    depth = torch.rand(b, k, s, generator=made, dtype=torch.float64).sort(-1).values
    feature = torch.randn(b, k, s, f, generator=made, dtype=torch.float64)
    direction = torch.randn(b, k, 3, generator=made, dtype=torch.float64)
    return Samples(depth, feature, direction)


def codes(b: int = 3) -> torch.Tensor:
    return torch.randn(b, 5, generator=generator(0, 0, "codes"), dtype=torch.float64)


@pytest.mark.parametrize("integration", INTEGRATIONS)
@pytest.mark.parametrize("norm", ["batch", "layer"])
def test_weights_are_positive_and_sum_to_one(integration, norm):
    weight = network(integration=integration, norm=norm)(samples(), codes())
    assert weight.shape == (3, 4) and (weight > 0).all()
    torch.testing.assert_close(weight.sum(1), torch.ones(3, dtype=torch.float64))


def test_the_order_of_the_moved_rays_does_not_matter():
    given, order = samples(), torch.tensor([0, 3, 1, 2])
    shuffled = given.map(lambda x, _: x[:, order])
    torch.testing.assert_close(network()(shuffled, codes()), network()(given, codes()))


def test_parameters_of_the_published_sizes():
    made = AdaptiveWeights(10, generator=generator(0, 0, "adaptive"))
    assert sum(p.numel() for p in made.parameters()) == 30_954
    embedding = sum(p.numel() for p in made.embed.parameters() if p.ndim == 2)
    assert embedding == 20_480  # multiplications for each sample


def slow_ray(integration: str, h, depth, length):
    """One ray's gathered feature, as published or as intended."""
    total = torch.zeros(h.shape[1], dtype=h.dtype)
    s_count = len(depth)
    alpha = torch.zeros_like(h)
    for s in range(s_count - 1):
        alpha[s] = 1 - torch.exp(-h[s] * (depth[s + 1] - depth[s]) * length)
    for s in range(s_count):
        for c in range(h.shape[1]):
            clear = 1.0
            if integration == "samples":
                clear = (1 - alpha[:s, c]).prod()
            elif s > 0:
                clear = (1 - alpha[s - 1, : c + 1] + 1e-10).prod()
            total[c] += clear * alpha[s, c] * h[s, c]
    return total


def layers(dense, x):
    for layer in dense.layers:
        x = torch.relu(linear(x, layer.weight, layer.bias))
    return x


def slow_weights(net: AdaptiveWeights, given: Samples, code) -> torch.Tensor:
    """The published network, one pixel and one ray at a time, up to the batch norm."""
    b_count, k_count, s_count = given.depth.shape
    global_, change = [], []
    for b in range(b_count):
        h = layers(net.embed, given.feature[b])  # [k, s, 64]
        rays = [
            slow_ray(net.integration, h[k], given.depth[b, k], given.direction[b, k].norm())
            for k in range(k_count)
        ]
        seen = frequencies(normalize(given.direction[b, 0], dim=0), 2)
        x = [layers(net.globalise, torch.cat([ray, code[b], seen])) for ray in rays]
        local = net.localise(h)
        score = net.attend(local)[..., 0]  # [k, s]
        inter = [
            sum(score[k].softmax(0)[s] * local[k, s] for s in range(s_count))
            for k in range(k_count)
        ]
        intra = [
            sum(score[:, s].softmax(0)[k] * local[k, s] for k in range(k_count))
            for s in range(s_count)
        ]
        part = net.aggregate
        for k in range(k_count):
            found = []
            for rows, key, value in (
                (torch.stack(inter), part.inter_key, part.inter_value),
                (torch.stack(intra), part.intra_key, part.intra_value),
            ):
                keys = key(rows)
                match = (keys @ part.query(x[k])).softmax(0)
                found.append(match @ value(keys))
            change.append(part.join(torch.cat(found)))
            global_.append(x[k])
    whole, change = torch.stack(global_), net.aggregate.norm(torch.stack(change))
    whole = leaky_relu(whole + change, 0.2).view(b_count, k_count, -1).mean(1)
    weight = net.head(whole).sigmoid()
    return weight / weight.sum(1, keepdim=True)


@pytest.mark.parametrize("integration", INTEGRATIONS)
@pytest.mark.parametrize("norm", ["batch", "layer"])
def test_it_is_the_published_network_written_as_loops(integration, norm):
    net, given, code = network(3, integration=integration, norm=norm), samples(2, 3, 4), codes(2)
    with torch.no_grad():
        torch.testing.assert_close(net(given, code), slow_weights(net, given, code))


def test_a_few_pixels_at_a_time_is_the_same_as_all_at_once(monkeypatch):
    net = network()
    given = replace(samples(), feature=samples().feature.requires_grad_())
    weight = net(given, codes())
    weight.square().sum().backward()
    slope = given.feature.grad
    monkeypatch.setattr(adaptive, "CPU_CHUNK", 1)
    again = replace(samples(), feature=samples().feature.requires_grad_())
    weight_again = net(again, codes())
    weight_again.square().sum().backward()
    torch.testing.assert_close(weight_again, weight)
    torch.testing.assert_close(again.feature.grad, slope)


def test_layer_norm_leaves_pixels_independent_and_batch_norm_does_not():
    given, part = samples(), samples()[:2]
    alone = network(norm="layer")
    torch.testing.assert_close(alone(part, codes()[:2]), alone(given, codes())[:2])
    coupled = network(norm="batch")
    assert not torch.allclose(coupled(part, codes()[:2]), coupled(given, codes())[:2])


@pytest.mark.parametrize("integration", INTEGRATIONS)
def test_gradients(integration):
    net, given = network(2, integration=integration), samples(2, 2, 3)

    def weigh(feature, code):
        return net(replace(given, feature=feature), code)

    feature, code = given.feature.requires_grad_(), codes(2).requires_grad_()
    assert torch.autograd.gradcheck(weigh, (feature, code))


def test_gradients_reach_every_parameter():
    net = network()
    (net(samples(), codes()) * torch.arange(4)).sum().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


def test_it_keeps_next_to_nothing_besides_the_features():
    net = AdaptiveWeights(10, generator=generator(0, 0, "adaptive"))
    feature = torch.randn(4, 10, 128, 128, requires_grad=True)
    kept: dict[int, int] = {}

    def keep(tensor):
        storage = tensor.untyped_storage()
        kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    depth = torch.rand(4, 10, 128).sort(-1).values
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        net(Samples(depth, feature, torch.randn(4, 10, 3)), torch.zeros(4, 32))
    kept.pop(feature.untyped_storage().data_ptr())
    assert sum(kept.values()) < 0.15 * 4 * feature.numel()


def test_it_reads_half_precision_features_without_a_copy():
    net = AdaptiveWeights(4, features=6, code=5, generator=generator(0, 0, "adaptive"))
    full = samples().map(lambda x, _: x.float())
    half = replace(full, feature=full.feature.bfloat16())
    weight = net(half, codes().float())
    assert weight.dtype == torch.float32
    torch.testing.assert_close(weight, net(full, codes().float()), atol=0.02, rtol=0)


def test_equal_depths_and_no_pixels():
    flat = replace(samples(), depth=torch.full((3, 4, 7), 0.5, dtype=torch.float64))
    assert network()(flat, codes()).isfinite().all()
    assert network(norm="layer")(samples(0), codes(0)).shape == (0, 4)
