"""Features of images: the published layout, read without enlarging, merged and mixed."""

import torch

from sharpfield.fields.image_features import MAPS, FeatureExtractor, Merging, Mixing
from sharpfield.ops.pyramid import sample_pyramid


def test_maps_are_a_half_a_quarter_and_an_eighth():
    levels = FeatureExtractor(3, seed=0)(torch.rand(2, 48, 64, 3))
    assert [tuple(level.shape) for level in levels] == [
        (2, 48, 64, 3),
        (2, 24, 32, 6),
        (2, 12, 16, 12),
        (2, 6, 8, 24),
    ]
    assert 3 + sum(MAPS) == 45


def test_reading_equals_enlarging_and_taking_the_pixel():
    images = torch.rand(3, 48, 64, 3, dtype=torch.float64)
    levels = FeatureExtractor(3, seed=0).double()(images)
    whole = torch.cat(
        [
            torch.nn.functional.interpolate(
                level.movedim(-1, 1), size=(48, 64), mode="bilinear", align_corners=False
            )
            for level in levels
        ],
        1,
    )
    y, x = torch.meshgrid(torch.arange(48), torch.arange(64), indexing="ij")
    xy = torch.stack([x, y], -1).reshape(-1, 2).double() + 0.5
    source = torch.full((len(xy),), 2)
    found = sample_pyramid(xy, source, levels)
    assert torch.allclose(found, whole[2].movedim(0, -1).reshape(-1, 45), atol=1e-12)


def test_sources_that_show_nothing_weigh_nothing():
    merging = Merging(5, 7, seed=0, width=8)
    shown, feature, change = torch.randn(4, 3, 5), torch.randn(4, 7), torch.randn(4, 3, 3)
    visible = torch.tensor([1.0, 0.0, 1.0]).expand(4, 3)
    merged, weight = merging(shown, feature, change, visible)
    assert (weight[:, 1] == 0).all()
    elsewhere = shown.clone()
    elsewhere[:, 1] += 100
    assert torch.equal(merging(elsewhere, feature, change, visible)[0], merged)
    nothing, _ = merging(shown, feature, change, torch.zeros(4, 3))
    assert not nothing.any()


def test_merging_is_that_of_the_joined_input():
    merging = Merging(5, 7, seed=0, width=8)
    shown, feature, change = torch.randn(4, 3, 5), torch.randn(4, 7), torch.randn(4, 3, 3)
    joined = torch.cat([shown, feature[:, None].expand(4, 3, 7), change], -1)
    expected = merging.network(joined)[..., 0].sigmoid()
    assert torch.allclose(merging(shown, feature, change, torch.ones(4, 3))[1], expected, atol=1e-6)


def test_mixing_adds_to_the_first_features_alone():
    mixing = Mixing(5, seed=0)
    feature, merged = torch.randn(6, 9), torch.randn(6, 5)
    mixed = mixing(feature, merged)
    assert torch.equal(mixed[:, 5:], feature[:, 5:])
    assert not torch.allclose(mixed[:, :5], feature[:, :5])
