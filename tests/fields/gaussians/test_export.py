import numpy as np
import torch

from sharpfield.core.tone import srgb
from sharpfield.fields.gaussians.export import export_splats, transformed
from sharpfield.fields.gaussians.static import FLAT, GREY, Gaussians
from sharpfield.geometry.se3 import rotation_exp
from sharpfield.geometry.space import Similarity
from sharpfield.storage.ply import read_splats
from tests.fields.gaussians.ply_files import import_splats
from tests.fields.gaussians.test_static import made

EYE = torch.tensor([[0.3, -0.2, -4.0]])


def test_what_is_exported_comes_back(tmp_path):
    scene = made(sh_degree=3)
    export_splats(scene, tmp_path / "a.ply")
    found = import_splats(tmp_path / "a.ply")
    torch.testing.assert_close(found.rotations, scene.rotations)
    for name in ("means", "log_scales", "opacity_logits", "harmonics"):
        torch.testing.assert_close(getattr(found, name), getattr(scene, name))


def test_quaternions_are_unit_length_for_viewers_that_do_not_normalise(tmp_path):
    export_splats(made(), tmp_path / "a.ply")
    lengths = np.linalg.norm(read_splats(tmp_path / "a.ply").quaternions, axis=-1)
    np.testing.assert_allclose(lengths, 1, rtol=1e-6)


def test_a_viewer_shows_linear_light_through_the_display_curve(tmp_path):
    colours = torch.tensor([[0.001, 0.2, 0.9]])
    scene = Gaussians.start(torch.zeros(1, 3), colours, torch.ones(1), sh_degree=1)
    scene.higher_harmonics.data += 1e-3 * torch.randn(1, 3, 3)
    export_splats(scene, tmp_path / "a.ply", encoding="linear", comments=("antialiased",))
    table = read_splats(tmp_path / "a.ply")
    assert table.comments == ("antialiased",)
    np.testing.assert_allclose(GREY + FLAT * table.harmonics[:, 0], srgb(colours), atol=1e-6)
    shown = scene.__class__(*(torch.from_numpy(v) for v in list(vars(table).values())[:5]))
    torch.testing.assert_close(shown.colours(EYE), srgb(scene.colours(EYE)), atol=1e-4, rtol=0)


def test_grey_is_written_as_three_equal_colours(tmp_path):
    scene = made(channels=1)
    export_splats(scene, tmp_path / "a.ply")
    found = import_splats(tmp_path / "a.ply")
    torch.testing.assert_close(found.harmonics, scene.harmonics.expand(-1, -1, 3))


def test_in_another_world_everything_looks_the_same():
    scene = made(sh_degree=3)
    turn = rotation_exp(torch.tensor([0.4, -1.1, 0.7], dtype=torch.float64)).numpy()
    change = Similarity(2.5, turn, np.array([1.0, -2.0, 0.5]))
    after = transformed(scene, change)
    there = torch.from_numpy(change.points(EYE.double().numpy())).float()
    torch.testing.assert_close(after.colours(there), scene.colours(EYE), atol=1e-5, rtol=1e-5)
    shape = lambda g: g.rotations @ torch.diag_embed(g.scales**2) @ g.rotations.mT  # noqa: E731
    turned = torch.from_numpy(turn).float()
    torch.testing.assert_close(shape(after), 6.25 * turned @ shape(scene) @ turned.T)
    torch.testing.assert_close(
        after.means.detach().double().numpy(),
        change.points(scene.means.detach().double().numpy()),
        atol=1e-5,
        rtol=1e-5,
        check_dtype=False,
    )


def test_exporting_to_another_world_is_moving_first(tmp_path):
    scene, change = made(), Similarity(2.0, np.eye(3), np.array([1.0, 0.0, 0.0]))
    export_splats(scene, tmp_path / "a.ply", change=change)
    np.testing.assert_allclose(
        read_splats(tmp_path / "a.ply").means, 2 * scene.means.detach() + torch.tensor([1.0, 0, 0])
    )
