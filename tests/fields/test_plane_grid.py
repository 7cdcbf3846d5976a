import pytest
import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from sharpfield.core.seed import generator
from sharpfield.fields.plane_grid import COARSE, FINE, HeadSize, PlaneField, PlaneHead, Volume
from sharpfield.ops import _dispatch
from sharpfield.ops.encoding import frequencies

BOX = torch.tensor([[-1.0, -2.0, 0.0], [1.0, 1.0, 5.0]])
SMALL = HeadSize(hidden=8, feature=4, colour=8)


def made() -> torch.Generator:
    return generator(0, 0, "field test")


def field(**change) -> PlaneField:
    """A field of a few hundred cells."""
    given: dict = {"heads": (SMALL, SMALL), "features": 5, "channels": (4, 3, 2), "octaves": (3, 2)}
    return PlaneField(BOX, (240, 1920), generator=made(), **{**given, **change})


def places(*shape: int) -> Tensor:
    """Points in the box."""
    unit = torch.rand(*shape, 3, generator=generator(0, 0, "places"))
    return BOX[0] + unit * (BOX[1] - BOX[0])


def count(*parts: nn.Module) -> int:
    return sum(p.numel() for part in parts for p in part.parameters())


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_features_fade_over_one_voxel_outside_the_box(axis: int):
    volume = Volume(BOX, 240, 5, generator=made(), channels=(4, 3, 2))
    cells = [volume.planes[0].shape[1], volume.planes[0].shape[0], volume.planes[1].shape[0]]
    voxel = (BOX[1] - BOX[0])[axis] / (cells[axis] - 1)
    point = places(4)
    for end, outward in ((0, -1.0), (1, 1.0)):
        point[:, axis] = BOX[end, axis]
        border = volume(point)
        for part in (0.25, 0.5, 1.0):
            beyond = point.clone()
            beyond[:, axis] += outward * part * voxel
            torch.testing.assert_close(volume(beyond), (1 - part) * border, rtol=0, atol=1e-5)
        beyond[:, axis] += outward
        assert not volume(beyond).any()


def test_the_box_ends_at_the_centres_of_the_outer_cells():
    volume = Volume(BOX, 240, 5, generator=made(), channels=(4, 3, 2))
    (xy, xz, yz), (z, y, x) = volume.planes, volume.lines
    for end, cell in ((0, 0), (1, -1)):
        pairs = [xy[cell, cell] * z[cell], xz[cell, cell] * y[cell], yz[cell, cell] * x[cell]]
        torch.testing.assert_close(volume(BOX[end]), volume.basis(torch.cat(pairs)))


def test_looking_closer_is_looking_everywhere_in_both_volumes():
    made_field, time = field(), torch.zeros(6)
    old, new = places(6, 7), places(6, 4) + 0.01
    features = made_field.coarse_features(old, time)
    found = made_field.fine_features(features, old, new, time)
    both = torch.cat([old, new], 1)
    wanted = torch.cat([made_field.volumes[0](both), made_field.volumes[1](both)], -1)
    torch.testing.assert_close(features, made_field.volumes[0](old))
    torch.testing.assert_close(found, wanted)


def test_colour_is_light_between_none_and_all():
    head = field().fine
    colour = head.colour(100 * torch.randn(6, 7, 4), torch.randn(6, 3))
    assert colour.shape == (6, 7, 3) and (colour >= 0).all() and (colour <= 1).all()


def test_the_same_generator_makes_the_same_field():
    first, second = field().state_dict(), field().state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_golden_sizes():
    """Ev-DeblurNeRF with the grid of its real camera, in a box of the published size."""
    box = torch.tensor([[-1.79035041, -1.01, -1.0001], [1.78457007, 1.00230769, 1.0001]])
    coarse = PlaneHead(32, COARSE, generator=made())
    fine = PlaneHead(64, FINE, generator=made())
    volume = Volume(box, 16_777_248, 32, generator=made())
    assert count(coarse, volume.basis) == 17_152
    assert count(fine, volume.basis) == 174_592
    assert count(volume.planes) == 7_049_824
    assert count(volume.lines) == 22_832


@pytest.mark.parametrize(
    ("features", "size", "golden"),
    [(32, COARSE, 14_080), (64, FINE, 171_520)],
    ids=["coarse", "fine"],
)
def test_multiplications(features: int, size: HeadSize, golden: int):
    """As published, less the direction's part, which is worked out once per ray."""
    head, samples = PlaneHead(features, size, generator=made()), 128
    with FlopCounterMode(display=False) as counter:
        _, hidden = head.density(torch.zeros(1, samples, features), torch.zeros(1, samples, 3))
        head.colour(head.feature(hidden), torch.zeros(1, 3))
    direction = 27 * size.colour
    wanted = samples * golden - (samples - 1) * direction
    assert counter.get_total_flops() == 2 * wanted


def test_a_head_is_its_plain_formulation():
    head, features, points = field().coarse, torch.randn(6, 7, 5), places(6, 7)
    direction = torch.nn.functional.normalize(torch.randn(6, 3), dim=-1)
    raw, hidden = head.density(features, points)
    colour = head.colour(head.feature(hidden), direction)

    x = torch.cat([features, frequencies(points, 3)], -1)
    first, second = head.inside.weight, head.out.weight
    out = torch.relu(x @ first.T) @ second.T
    toward = frequencies(direction, 2)[:, None].expand(-1, 7, -1)
    joined = torch.cat([head.first.of_sample, head.first.of_ray], 1)
    x = torch.relu(torch.cat([out[..., 1:], toward], -1) @ joined.T)
    third, fourth = (layer.weight for layer in head.last.layers)
    torch.testing.assert_close(raw, out[..., 0])
    torch.testing.assert_close(colour, torch.sigmoid(torch.relu(x @ third.T) @ fourth.T))


def test_half_precision_is_near_and_ends_in_float32():
    exact, rough = field().fine, field(precision=torch.bfloat16).fine
    features, points, direction = torch.randn(6, 7, 10), places(6, 7), torch.randn(6, 3)
    (raw, hidden), (raw16, hidden16) = (head.density(features, points) for head in (exact, rough))
    colour, colour16 = (
        head.colour(head.feature(seen), direction)
        for head, seen in ((exact, hidden), (rough, hidden16))
    )
    assert raw16.dtype == colour16.dtype == torch.float32 and hidden16.dtype == torch.bfloat16
    torch.testing.assert_close(raw16, raw, rtol=0.02, atol=0.03)
    torch.testing.assert_close(colour16, colour, rtol=0, atol=0.02)
    assert not torch.equal(colour16, colour)


def test_gradients_of_a_volume():
    volume = Volume(BOX, 60, 2, generator=made(), channels=(2, 1, 1)).double()
    point = places(3).double().requires_grad_()
    parameters = tuple(volume.parameters())
    names = [name for name, _ in volume.named_parameters()]

    def coarse_features(point: Tensor, *values: Tensor) -> Tensor:
        return torch.func.functional_call(volume, dict(zip(names, values, strict=True)), (point,))

    with _dispatch.using("reference"):
        assert torch.autograd.gradcheck(coarse_features, (point, *parameters))


def test_every_parameter_of_a_field_learns():
    made_field, time = field(), torch.zeros(6)
    old, new, direction = places(6, 50), places(6, 50), torch.randn(6, 3)
    features = made_field.coarse_features(old, time)
    close = made_field.fine_features(features, old, new, time)
    total = torch.zeros(())
    for head, seen, points in (
        (made_field.coarse, features, old),
        (made_field.fine, close, torch.cat([old, new], 1)),
    ):
        raw, hidden = head.density(seen, points)
        total = total + raw.sum() + head.colour(head.feature(hidden), direction).sum()
    total.backward()
    assert all(p.grad is not None and p.grad.any() for p in made_field.parameters())


def test_planes_and_lines_are_all_of_the_grids():
    made_field = field()
    assert len(made_field.planes()) == len(made_field.lines()) == 6
    assert sum(p.numel() for p in made_field.planes()) == count(
        *(volume.planes for volume in made_field.volumes)
    )


def test_no_points():
    made_field, none = field(), torch.zeros(0)
    features = made_field.coarse_features(torch.zeros(0, 7, 3), none)
    assert features.shape == (0, 7, 5)
    assert made_field.coarse.density(features, torch.zeros(0, 7, 3))[0].shape == (0, 7)
