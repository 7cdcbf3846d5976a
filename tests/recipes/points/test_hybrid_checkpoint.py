"""Checkpoints of the released code: recognised, loaded to the same numbers, and safely."""

import os
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from sharpfield.core.errors import RunError
from sharpfield.initialisation.point_cloud import CloudOptions
from sharpfield.recipes.hybrid import BlurOptions, Hybrid
from sharpfield.recipes.points.hybrid_checkpoint import read_released
from sharpfield.recipes.points.model import PatchSamplingOptions, PointModel
from tests.recipes.box import box

COUNT = 321
LINEAR = {
    "block1": [(284, 256), (256, 256)],
    "block3": [(263, 256), (256, 256)],
    "alpha_branch": [(256, 1)],
    "color_branch": [(280, 128), (128, 128), (128, 128), (128, 3)],
    "color_feature_branch": [(280, 128), (128, 128), (128, 128)],
    "aux_merge_weight_block": [(176, 64), (64, 64), (64, 64), (64, 1)],
    "color_mixup_block": [(90, 45), (45, 45), (45, 45)],
    "color_final_block": [(128, 3)],
    "learn_blur_kernel_block": [(128, 128), (128, 128), (128, 128), (128, 82)],
}
CONVOLVED = {"aux_block_s1": (3, 6), "aux_block_s2": (6, 12), "aux_block_s3": (12, 24)}


def released() -> dict[str, Tensor]:
    """What the released code saves, with numbers by chance."""
    made = torch.Generator().manual_seed(3)

    def drawn(*shape: int) -> Tensor:
        return 0.05 * torch.randn(shape, generator=made)

    table = {
        "neural_points.xyz": 2 + drawn(COUNT, 3),
        "neural_points.points_embeding": drawn(1, COUNT, 32),
        "neural_points.points_conf": 1 - drawn(1, COUNT, 1).abs(),
        "neural_points.points_dir": drawn(1, COUNT, 3),
        "neural_points.points_color": drawn(1, COUNT, 3),
    }
    for name, layers in LINEAR.items():
        for index, (inputs, outputs) in enumerate(layers):
            table[f"aggregator.{name}.{2 * index}.weight"] = drawn(outputs, inputs)
            table[f"aggregator.{name}.{2 * index}.bias"] = drawn(outputs)
    for name, (inputs, outputs) in CONVOLVED.items():
        for index, before in enumerate((inputs, outputs)):
            table[f"aggregator.{name}.{2 * index}.weight"] = drawn(outputs, before, 3, 3)
            table[f"aggregator.{name}.{2 * index}.bias"] = drawn(outputs)
    return table


def published(path: Path) -> Hybrid:
    return Hybrid(
        sampling=PatchSamplingOptions(patches=2, patch_size=8, border=0, spacing=(1, 1)),
        cloud=CloudOptions(max_points=200),
        blur=BlurOptions(kind="learned"),
        frame_quality="even",
        checkpoint=str(path),
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "200000_net_ray_marching.pth"
    torch.save(released(), path)
    return path


def test_points_and_networks_are_those_of_the_file(file: Path):
    model = published(file).build(box(), 0)
    table, field = released(), model.scene.field
    assert len(field.points) == COUNT
    assert torch.equal(field.points.positions, table["neural_points.xyz"])
    assert torch.equal(field.points.colours, table["neural_points.points_color"][0])
    ours = {
        "block1.2.weight": field.reading.layers[1].weight,
        "block3.0.bias": field.seeing.layers[0].bias,
        "color_feature_branch.4.weight": field.to_feature.layers[2].weight,
        "aux_merge_weight_block.6.weight": model.images.merging.network.layers[3].weight,
        "aux_block_s2.2.weight": model.images.extractor.stages[1][1].weight,
        "color_mixup_block.4.bias": model.images.mixing.network.layers[2].bias,
        "color_final_block.0.weight": model.head.layer.layers[0].weight,
        "learn_blur_kernel_block.6.weight": model.blur.network.layers[3].weight,
    }
    for name, parameter in ours.items():
        assert torch.equal(parameter, table[f"aggregator.{name}"]), name


def test_density_is_that_of_the_released_formula(file: Path):
    """Written out for one place as the paper has it, layer by layer, on joined inputs."""
    model, table = published(file).build(box(), 0), released()
    field = model.scene.field
    place = torch.tensor([[2.01, 2.0, 1.99]])
    rows, way = field.points.positions.sub(place).norm(dim=-1).topk(8, largest=False).indices, None
    rows = rows[None]
    way = field.points.positions[rows[0]][None] - place[:, None]
    direction, turn = torch.tensor([[0.3, -0.2, 1.1]]), torch.linalg.qr(torch.eye(3) + 0.1).Q[None]

    def layer(name: str, index: int, x: Tensor) -> Tensor:
        weight = table[f"aggregator.{name}.{2 * index}.weight"]
        return x @ weight.T + table[f"aggregator.{name}.{2 * index}.bias"]

    def waves(x: Tensor, octaves: int) -> Tensor:
        out = []
        for value in x:
            for octave in range(octaves):
                out += [torch.sin(2**octave * value), torch.cos(2**octave * value)]
        return torch.stack(out)

    leak = torch.nn.functional.leaky_relu
    weight = 1 / way[0].norm(dim=-1)
    weight = weight / weight.sum()
    density, hidden = 0.0, torch.zeros(256)
    for k, row in enumerate(rows[0].tolist()):
        told = table["neural_points.points_embeding"][0, row]
        offset = torch.cat([way[0, k], turn[0] @ way[0, k]])
        x = torch.cat([told, waves(told, 3), waves(offset, 5)])
        x = leak(layer("block1", 1, leak(layer("block1", 0, x))))
        seen = table["neural_points.points_dir"][0, row]
        extra = [table["neural_points.points_color"][0, row], seen - direction[0]]
        x = torch.cat([x, *extra, (seen @ direction[0])[None]])
        x = leak(layer("block3", 1, leak(layer("block3", 0, x))))
        share = weight[k] * table["neural_points.points_conf"][0, row, 0]
        raw = layer("alpha_branch", 0, x)[0]
        density = density + share * torch.nn.functional.softplus(raw - 1)
        hidden = hidden + share * x
    found, kept = field.density(rows, way, direction, turn)
    assert found[0].item() == pytest.approx(float(density), rel=1e-4)
    assert torch.allclose(kept[0], hidden, atol=1e-5)
    encoded = [
        hidden,
        *[
            torch.stack([f(2**o * v) for v in direction[0] for o in range(4)])
            for f in (torch.sin, torch.cos)
        ],
    ]
    x = torch.cat(encoded)
    for index in range(3):
        x = leak(layer("color_feature_branch", index, x))
    assert torch.allclose(field.feature(kept, direction)[0], x, atol=1e-5)


def test_other_sizes_are_refused_in_words(file: Path):
    recipe = published(file)
    recipe = replace(recipe, sizes=replace(recipe.sizes, width=128))
    with pytest.raises(RunError, match="has other sizes than the recipe"):
        recipe.build(box(), 0)


def test_a_file_that_would_run_something_is_refused(tmp_path: Path):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "ran"),)

    path = tmp_path / "evil.pth"
    torch.save({"neural_points.xyz": Evil()}, path)
    with pytest.raises(RunError, match="cannot be read as tensors alone"):
        read_released(path)
    path.write_bytes(pickle.dumps(Evil()))
    with pytest.raises(RunError, match="cannot be read as tensors alone"):
        read_released(path)
    assert not (tmp_path / "ran").exists()


def test_other_files_are_refused_in_words(tmp_path: Path):
    path = tmp_path / "states.pth"
    torch.save({"epoch_count": torch.tensor(3), "total_steps": torch.tensor(7)}, path)
    with pytest.raises(RunError, match="this is not a checkpoint of Hybrid Neural Rendering"):
        read_released(path)
    with pytest.raises(RunError, match="there is no such checkpoint"):
        read_released(tmp_path / "nowhere.pth")
    path.write_bytes(b"no checkpoint")
    with pytest.raises(RunError, match="cannot be read as tensors alone"):
        read_released(path)


def test_what_was_loaded_renders(file: Path):
    model = published(file).build(box(), 0)
    assert isinstance(model, PointModel)
    loss = model.losses(model.draw(0), 0)
    assert all(term.isfinite() for term in loss.values())
