import dataclasses

import pytest
import torch
from torch import Tensor

from sharpfield.core.seed import generator
from sharpfield.fields.plane_grid import HeadSize, PlaneHead
from sharpfield.ops.encoding import frequencies
from sharpfield.rendering import coarse_to_fine as module
from sharpfield.rendering.coarse_to_fine import Compositing, RayPoints, RenderedRays, composite_head

RAYS, SAMPLES, LOOKED = 11, 24, 5
HOWS = {
    "frustum": Compositing(),
    "metric": Compositing(torch.nn.functional.softplus, opaque_end=False, background=0.7),
    "cleared": Compositing(opaque_end=False, clear_before=0.4),
}
EVERY_HOW = pytest.mark.parametrize("how", HOWS.values(), ids=HOWS.keys())


def head() -> PlaneHead:
    return PlaneHead(LOOKED, HeadSize(16, 6, 16), generator=generator(0, 0, "head"))


def work(rays: int = RAYS, *, ordered: bool = False, noisy: bool = False) -> RayPoints:
    """Random rays; points lie in a random order, unless `ordered`."""
    made = generator(0, 0, "work")

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=made)

    z = torch.rand(rays, SAMPLES, generator=made).sort(-1).values
    order = torch.rand(rays, SAMPLES, generator=made).argsort(-1)
    return RayPoints(
        3 * normal(rays, SAMPLES, LOOKED),
        normal(rays, SAMPLES, 3),
        z,
        4 + torch.rand(rays, generator=made),
        torch.nn.functional.normalize(normal(rays, 3), dim=-1),
        order=None if ordered else order,
        noise=normal(rays, SAMPLES) if noisy else None,
    )


def plain(head: PlaneHead, work: RayPoints, how: Compositing) -> RenderedRays:
    """Sorted before the networks, the direction repeated for every sample, one loop per sample."""
    features, points = work.features, work.points
    if work.order is not None:
        order = work.order[..., None]
        features = features.gather(1, order.expand_as(features))
        points = points.gather(1, order.expand_as(points))
    first, second = head.inside.weight, head.out.weight
    out = torch.relu(torch.cat([features, frequencies(points, 10)], -1) @ first.T) @ second.T
    raw, feature = out[..., 0], out[..., 1:]
    toward = frequencies(work.direction, 4)[:, None].expand(-1, SAMPLES, -1)
    joined = torch.cat([head.first.of_sample, head.first.of_ray], 1)
    third, fourth = (layer.weight for layer in head.last.layers)
    x = torch.relu(torch.cat([feature, toward], -1) @ joined.T)
    colour = torch.sigmoid(torch.relu(x @ third.T) @ fourth.T)

    density = how.activation(raw if work.noise is None else raw + work.noise)
    passed, weights = torch.ones(len(work)), []
    for j in range(SAMPLES):
        last = j == SAMPLES - 1
        following = work.z[:, j] if last else work.z[:, j + 1]
        gap = torch.full_like(passed, 1e10) if last else following - work.z[:, j]
        seen = density[:, j] * (following > how.clear_before)
        alpha = 1 - torch.exp(-seen * gap * work.length)
        alpha = torch.ones_like(alpha) if last and how.opaque_end else alpha
        weights.append(passed * alpha)
        passed = passed * (1 - alpha + 1e-10)
    weights = torch.stack(weights, -1)
    rgb = (weights[..., None] * colour).sum(1)
    if not how.opaque_end:
        rgb = rgb + how.background * (1 - weights.sum(-1, keepdim=True))
    return RenderedRays(rgb, (weights * work.z).sum(-1), weights.sum(-1), weights, feature)


def pulled(found: RenderedRays) -> Tensor:
    """A number that everything found has a say in."""
    made = generator(0, 0, "pull")
    values = [found.rgb, found.depth, found.opacity, found.weights, found.feature]
    return sum(
        (
            (value * torch.randn(value.shape, generator=made)).sum()
            for value in values
            if value is not None
        ),
        torch.zeros(()),
    )


@EVERY_HOW
@pytest.mark.parametrize("chunk", [4 * SAMPLES, 1 << 13])
@pytest.mark.parametrize("noisy", [False, True])
def test_it_is_the_plain_formulation(how: Compositing, chunk: int, noisy: bool, monkeypatch):
    """In values and in the gradients of everything that learns."""
    monkeypatch.setitem(module.CHUNK, "cpu", chunk)
    results = []
    for render in (plain, composite_head):
        network, given = head(), work(noisy=noisy)
        features = given.features.requires_grad_()
        more = {"keep_feature": True} if render is composite_head else {}
        found = render(network, given, how, **more)
        gradients = torch.autograd.grad(pulled(found), [features, *network.parameters()])
        results.append((found, gradients))
    (wanted, slopes), (found, gradients) = results
    for name, value in vars(wanted).items():
        torch.testing.assert_close(getattr(found, name), value, rtol=1e-4, atol=1e-5)
    for one, other in zip(gradients, slopes, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


@EVERY_HOW
def test_points_in_order_need_no_order(how: Compositing):
    given = work(ordered=True)
    same = dataclasses.replace(given, order=torch.arange(SAMPLES).expand(RAYS, SAMPLES))
    found, wanted = composite_head(head(), given, how), composite_head(head(), same, how)
    torch.testing.assert_close(found.rgb, wanted.rgb)
    torch.testing.assert_close(found.weights, wanted.weights)


@EVERY_HOW
@pytest.mark.parametrize("chunk", [4 * SAMPLES, 1 << 13])
def test_colours_left_out_in_evaluation_do_not_show(how: Compositing, chunk: int, monkeypatch):
    monkeypatch.setitem(module.CHUNK, "cpu", chunk)
    network, given = head(), work()
    given = dataclasses.replace(given, length=40 * given.length)
    full = composite_head(network, given, how, keep_feature=True)
    with torch.no_grad():
        seen = composite_head(network, given, how, keep_feature=True)
    dim = (full.weights > 0) & (full.weights < module.MIN_WEIGHT_EVAL)
    assert dim.any(), "there must be something to leave out"
    torch.testing.assert_close(seen.rgb, full.rgb, rtol=0, atol=1e-3)
    for name in ("depth", "opacity", "weights", "feature"):
        torch.testing.assert_close(getattr(seen, name), getattr(full, name).detach())


def test_training_asks_for_the_colour_of_lit_points_only(monkeypatch):
    """A density that is not positive has no colour to show and nothing to learn."""
    monkeypatch.setattr(module, "MULTIPLE", 8)
    network, given = head(), work(noisy=True)
    selected: list[int] = []
    colour = network.colour
    monkeypatch.setattr(
        network,
        "colour",
        lambda feature, seen: selected.append(len(feature)) or colour(feature, seen),
    )
    found = composite_head(network, given, HOWS["frustum"])
    lit = int((found.weights > module.MIN_WEIGHT_TRAIN).sum())
    assert lit <= sum(selected) < lit + 8 < 0.9 * RAYS * SAMPLES


@pytest.mark.parametrize("seeing", [torch.no_grad, torch.enable_grad])
def test_an_opaque_end_stops_all_light(seeing):
    with seeing():
        found = composite_head(head(), work(), HOWS["frustum"])
        open_end = composite_head(head(), work(), HOWS["cleared"])
    torch.testing.assert_close(found.opacity, torch.ones(RAYS))
    assert (open_end.opacity < 0.999).any()


@pytest.mark.parametrize("seeing", [torch.no_grad, torch.enable_grad])
def test_nothing_is_seen_before_the_clear_part_ends(seeing):
    given, how = work(), Compositing(clear_before=0.4)
    with seeing():
        found, all_of_it = (
            composite_head(head(), given, how),
            composite_head(head(), given, Compositing()),
        )
    following = torch.cat([given.z[:, 1:], given.z[:, -1:]], -1)
    assert not found.weights[following <= 0.4].any()
    assert all_of_it.weights[following <= 0.4].any()


def test_behind_nothing_is_the_background():
    network = head()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
    how = Compositing(opaque_end=False, background=0.7)
    for seeing in (torch.no_grad, torch.enable_grad):
        with seeing():
            found = composite_head(network, work(), how)
        torch.testing.assert_close(found.rgb, torch.full((RAYS, 3), 0.7))
        assert not found.opacity.any()


def test_features_come_only_when_asked_for():
    assert composite_head(head(), work(), Compositing()).feature is None


@pytest.mark.parametrize("seeing", [torch.no_grad, torch.enable_grad])
def test_no_rays(seeing):
    with seeing():
        found = composite_head(head(), work(0), Compositing())
    assert found.rgb.shape == (0, 3) and found.weights.shape == (0, SAMPLES)
