import bz2

import pytest

from sharpfield.recordings.bytes import DamagedData, decompress

DATA = bytes(range(256)) * 100


def packed(packing: str) -> bytes:
    if packing == "bz2":
        return bz2.compress(DATA)
    if packing == "lz4":
        return pytest.importorskip("lz4.frame").compress(DATA)
    return pytest.importorskip("zstandard").ZstdCompressor().compress(DATA)


@pytest.mark.parametrize("packing", ["bz2", "lz4", "zstd"])
def test_blocks(packing: str, monkeypatch) -> None:
    assert decompress(packed(packing), packing) == DATA
    monkeypatch.setattr("sharpfield.recordings.bytes.OUTPUT_STEP", 1000)
    assert decompress(packed(packing), packing) == DATA
    assert decompress(DATA, "none") is DATA


@pytest.mark.parametrize("packing", ["bz2", "lz4", "zstd"])
def test_damage(packing: str, monkeypatch) -> None:
    data = packed(packing)
    for broken in (b"", data[:3], data[: len(data) // 2], b"x" + data):
        with pytest.raises(DamagedData):
            decompress(broken, packing)
    monkeypatch.setattr("sharpfield.recordings.bytes.MAX_BLOCK", len(DATA) - 1)
    with pytest.raises(DamagedData, match="grows without end"):
        decompress(data, packing)


def test_unknown_packings() -> None:
    with pytest.raises(DamagedData, match="compression 'rar'"):
        decompress(b"", "rar")
