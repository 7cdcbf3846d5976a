import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.lens_files import read_yaml


def parsed(tmp_path, text: str):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    return read_yaml(path)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("", {}),
        ("# nothing\n", {}),
        ("a: 1\nb: 2.5e-3\nc: text # remark\n", {"a": 1, "b": 0.0025, "c": "text"}),
        ("a: true\nb: null\nc: ~\nd:\n", {"a": True, "b": None, "c": None, "d": None}),
        ("a: [1, 2., -3e1]\n", {"a": [1, 2.0, -30.0]}),
        ("a: [[1, 2],\n    [3, 4]]\nb: 5\n", {"a": [[1, 2], [3, 4]], "b": 5}),
        ("a: {b: 1, c: [2, x y]}\n", {"a": {"b": 1, "c": [2, "x y"]}}),
        ("a:\n  b:\n    c: 1\n  d: 2\n", {"a": {"b": {"c": 1}, "d": 2}}),
        ("a:\n- 1\n- [2, 3]\n", {"a": [1, [2, 3]]}),
        ("a:\n  - 1\n  - - 2\n    - 3\n", {"a": [1, [2, 3]]}),
        ("a:\n- b: 1\n  c: 2\n- b: 3\n", {"a": [{"b": 1, "c": 2}, {"b": 3}]}),
        ("%YAML:1.0\n---\nm: !!opencv-matrix\n   dt: d\n   data: [ 1.,\n 2. ]\n",
         {"m": {"dt": "d", "data": [1.0, 2.0]}}),
        ("a: |\n  long\n  text\n", {"a": "long\ntext\n"}),
        ("a: {b 1}\n", {"a": {"b 1": None}}),
        ("a: on\nb: 1:30\nc: 012\nd: 2001-01-01\ne: 1e-3\nf: 2e5\n",
         {"a": "on", "b": "1:30", "c": 12, "d": "2001-01-01", "e": 0.001, "f": 2e5}),
        ('t: /cam0/image_raw\nq: "a: b"\n', {"t": "/cam0/image_raw", "q": "a: b"}),
    ],
)  # fmt: skip
def test_what_calibration_programs_write(tmp_path, text, wanted):
    assert parsed(tmp_path, text) == wanted


@pytest.mark.parametrize(
    "text",
    [
        "a: [1, 2\n", "a: ]\n", "a: 1\n   b: 2\n", "just words\n", "a: &x 1\nb: *x\n",
        "- 1\n- 2\n", "a: [1 2] 3\n", "a: {1: [}\n", "a: 1\nb: 2\na: 3\n", "[a]: 1\n",
        "a: !!python/object:os.system [x]\n  b: 1\n", "a: !!int x\n", "a: !!int [1]\n",
    ],
)  # fmt: skip
def test_all_else_is_refused_with_its_line(tmp_path, text):
    with pytest.raises(CaptureError, match="cannot read this YAML") as caught:
        parsed(tmp_path, text)
    assert "line" in str(caught.value)


@pytest.mark.parametrize("tag", ["!python/name:os.system", "!python/object/apply:os.getcwd", "own"])
def test_tags_name_no_code(tmp_path, tag):
    assert parsed(tmp_path, f"a: !{tag} x\nb: !{tag} [y]\n") == {"a": "x", "b": ["y"]}


def test_depth_and_length_are_bounded(tmp_path):
    with pytest.raises(CaptureError, match="nested too deeply"):
        parsed(tmp_path, "a: " + "[" * 100 + "]" * 100)
    with pytest.raises(CaptureError, match="too large"):
        parsed(tmp_path, "a: 1\n" * 300_000)


def test_damaged_files_end_well(tmp_path):
    text = b"cam0:\n  K: [1, 2, [3.5, 4]]\n  T:\n  - [1, 0]\n  - {a: 1}\n  name: 'x'\n"
    draw = np.random.default_rng(0)
    for _ in range(400):
        data = np.frombuffer(text, np.uint8).copy()
        places = draw.integers(len(data), size=3)
        data[places] = np.frombuffer(b"[]{}:,-# \n'\"&!ab1\xff", np.uint8)[
            draw.integers(18, size=3)
        ]
        path = tmp_path / "c.yaml"
        path.write_bytes(data.tobytes())
        try:
            assert isinstance(read_yaml(path), dict)
        except CaptureError:
            continue
