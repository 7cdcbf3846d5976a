from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from sharpfield.core.errors import CaptureError
from sharpfield.core.seed import numpy_generator
from sharpfield.ops.encoding import spherical_harmonics
from sharpfield.storage.ply import Ply, SplatTable, read_ply, read_splats, write_ply, write_splats


def made(count: int = 7, *, degree: int = 3) -> SplatTable:
    draw = numpy_generator(0, 0, "splats")

    def normal(*shape: int) -> np.ndarray:
        return draw.normal(size=shape).astype(np.float32)

    return SplatTable(
        normal(count, 3),
        normal(count, 4),
        normal(count, 3),
        normal(count),
        normal(count, (degree + 1) ** 2, 3),
        ("a comment",),
    )


@pytest.mark.parametrize("degree", range(4))
def test_what_is_written_comes_back_exactly(tmp_path, degree: int):
    splats = made(degree=degree)
    write_splats(tmp_path / "a.ply", splats)
    found = read_splats(tmp_path / "a.ply")
    for field in fields(SplatTable):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(splats, field.name))


def test_none_at_all(tmp_path):
    write_splats(tmp_path / "a.ply", made(0))
    assert read_splats(tmp_path / "a.ply").harmonics.shape == (0, 16, 3)


def test_properties_have_the_order_of_the_released_code(tmp_path):
    write_splats(tmp_path / "a.ply", made())
    ply = read_ply(tmp_path / "a.ply")
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(45)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert ply.rows.dtype == np.dtype([(name, "<f4") for name in names])


def test_harmonics_mean_what_the_released_code_computes(tmp_path):
    """Its polynomials, with their signs, on the numbers in the file."""
    splats = made()
    write_splats(tmp_path / "a.ply", splats)
    rows = read_ply(tmp_path / "a.ply").rows
    x, y, z = np.array([2.0, -3.0, 6.0]) / 7
    theirs = [
        0.28209479177387814,
        *(0.4886025119029199 * v for v in (-y, z, -x)),
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    ours = spherical_harmonics(torch.tensor([x, y, z]), 3).numpy()
    for channel in range(3):
        held = [rows[f"f_dc_{channel}"]]
        held += [rows[f"f_rest_{15 * channel + k}"] for k in range(15)]
        light = sum(v * values for v, values in zip(theirs, held, strict=True))
        np.testing.assert_allclose(light, splats.harmonics[..., channel] @ ours, atol=1e-5)


def test_files_of_others_are_refused(tmp_path):
    path = tmp_path / "a.ply"
    points = np.zeros(2, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1")])
    write_ply(path, Ply(points))
    with pytest.raises(CaptureError, match="vertices have no f_dc_0, f_dc_1, f_dc_2"):
        read_splats(path)
    write_splats(path, made(degree=1))
    rows = read_ply(path).rows
    fewer = np.empty(len(rows), [d for d in rows.dtype.descr if d[0] != "f_rest_8"])
    for name in fewer.dtype.names:
        fewer[name] = rows[name]
    write_ply(path, Ply(fewer))
    with pytest.raises(
        CaptureError, match=r"got    8 properties f_rest_\*\n  do     there must be 0, 9"
    ):
        read_splats(path)


def test_what_is_not_finite_is_refused(tmp_path):
    splats = made()
    means = splats.means.copy()
    means[3, 1] = np.nan
    write_splats(tmp_path / "a.ply", replace(splats, means=means))
    with pytest.raises(CaptureError, match="not finite\n  where  .*\n  got    in x, y, z"):
        read_splats(tmp_path / "a.ply")


def test_a_file_cut_off_is_told(tmp_path):
    path = tmp_path / "a.ply"
    write_splats(path, made())
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CaptureError, match="ends too early"):
        read_splats(path)
