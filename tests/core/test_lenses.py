import pytest
import torch

from sharpfield.core.lenses import BROWN, FISHEYE, LENSES, PINHOLE, lens_in_calibration

BENT = {PINHOLE: (), BROWN: (0.1, -0.05, 0.002, -0.001, 0.01), FISHEYE: (0.1, -0.05, 0.02, -0.004)}


@pytest.mark.parametrize("lens", BENT, ids=lambda lens: lens.name)
def test_unproject_inverts_project(lens):
    points = torch.tensor([[0.3, -0.2, 1.0], [0.0, 0.0, 2.0], [-0.5, 0.4, 1.5]]).double()
    back = lens.unproject(lens.project(points, BENT[lens]), BENT[lens])
    torch.testing.assert_close(back / back[..., 2:], points / points[..., 2:])


def test_the_registry_holds_each_by_its_name():
    assert list(LENSES) == ["pinhole", "brown", "fisheye"]
    assert all(LENSES[name].name == name for name in LENSES)


def test_names_in_calibration_files():
    assert lens_in_calibration("radtan") is BROWN
    assert lens_in_calibration("equidistant") is FISHEYE
    assert lens_in_calibration("none") is PINHOLE
    assert lens_in_calibration("omni") is None


def test_missing_coefficients_are_zero():
    assert BROWN.padded((0.1, 0.2, 0.3, 0.4)) == (0.1, 0.2, 0.3, 0.4, 0.0)


def test_colmap_parameters_are_intrinsics_and_known_coefficients():
    for lens in (PINHOLE, BROWN, FISHEYE):
        assert {name for name in lens.colmap[0].parameters if name[0] in "kp"} <= {
            *lens.coefficients
        }
