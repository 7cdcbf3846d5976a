"""LPIPS with random weights: the published ones are the user's to bring."""

import hashlib
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from sharpfield.core.errors import OptionError, ShapeError
from sharpfield.metrics.lpips import BACKBONES, Lpips, load_lpips


def backbone_layers(network: str) -> nn.Sequential:
    """The convolutional part of AlexNet or VGG-16, as their papers draw it."""
    if network == "alex":
        return nn.Sequential(
            *(nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2)),
            *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
            *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
            *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
            *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 2)),
        )
    layers: list[nn.Module] = []
    entering = 3
    for item in [64, 64, "M", 128, 128, "M", *[256] * 3, "M", *[512] * 3, "M", *[512] * 3, "M"]:
        if item == "M":
            layers.append(nn.MaxPool2d(2, 2))
        else:
            layers += [nn.Conv2d(entering, int(item), 3, padding=1), nn.ReLU()]
            entering = int(item)
    return nn.Sequential(*layers)


TAPS = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}
CHANNELS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}


def weight_files(folder: Path, network: str) -> tuple[Path, Path, nn.Sequential]:
    with torch.random.fork_rng():
        torch.manual_seed(1)
        layers = backbone_layers(network)
        linear = {
            f"lin{i}.model.1.weight": torch.rand(1, c, 1, 1)
            for i, c in enumerate(CHANNELS[network])
        }
    kernels = {f"features.{name}": value for name, value in layers.state_dict().items()}
    torch.save(kernels | {"classifier.1.weight": torch.zeros(3)}, folder / "net.pth")
    torch.save(linear, folder / "lin.pth")
    return folder / "net.pth", folder / "lin.pth", layers


def pair() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(2)
    return torch.rand(63, 70, 3, generator=generator), torch.rand(63, 70, 3, generator=generator)


@pytest.fixture(scope="module")
def alex(tmp_path_factory: pytest.TempPathFactory) -> Lpips:
    backbone, linear, _ = weight_files(tmp_path_factory.mktemp("alex"), "alex")
    return load_lpips(backbone, linear)


def test_equal_images_have_no_distance_and_order_does_not_matter(alex: Lpips):
    a, b = pair()
    assert alex(a, a).item() == 0
    assert alex(a, b).item() == pytest.approx(alex(b, a).item(), rel=1e-5)
    assert alex(a, b) > alex(a, 0.9 * a + 0.1 * b) > 0


@pytest.mark.parametrize("network", ["alex", "vgg"])
def test_the_graph_equals_the_definition(tmp_path: Path, network: str):
    backbone, linear, layers = weight_files(tmp_path, network)
    weights = torch.load(linear, weights_only=True)
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x, y = ((p * 2 - 1 - shift) / scale for p in pair())
    x, y = x.permute(2, 0, 1)[None], y.permute(2, 0, 1)[None]
    wanted = 0.0
    with torch.no_grad():
        for place, layer in enumerate(layers):
            x, y = layer(x), layer(y)
            if place in TAPS[network]:
                unit = [f / (f.square().sum(1, keepdim=True).sqrt() + 1e-10) for f in (x, y)]
                weight = weights[f"lin{TAPS[network].index(place)}.model.1.weight"]
                wanted += (weight * (unit[0] - unit[1]) ** 2).sum(1).mean().item()
    found = load_lpips(backbone, linear, network=network)(*pair()).item()
    assert found == pytest.approx(wanted, rel=1e-5)


def test_linear_layers_of_torchmetrics_fit(tmp_path: Path):
    package = pytest.importorskip("torchmetrics.functional.image.lpips")
    folder = Path(package.__file__).parent / "lpips_models"
    for network in BACKBONES:
        backbone, _, _ = weight_files(tmp_path, network)
        loaded = load_lpips(backbone, folder / f"{network}.pth", network=network)
        assert all((weight >= 0).all() for weight in loaded.linear)


def test_safetensors_give_the_same_and_hashes_are_kept(tmp_path: Path, alex: Lpips):
    backbone, linear, _ = weight_files(tmp_path, "alex")
    save_file(torch.load(backbone, weights_only=True), tmp_path / "net.safetensors")
    again = load_lpips(tmp_path / "net.safetensors", linear)
    assert again(*pair()).item() == alex(*pair()).item()
    assert again.sha256["linear"] == hashlib.sha256(linear.read_bytes()).hexdigest()
    assert again.sha256["backbone"] != alex.sha256["backbone"]


def test_small_images(alex: Lpips):
    assert alex(torch.zeros(31, 31, 3), torch.ones(31, 31, 3)) > 0
    with pytest.raises(ShapeError, match=r"at least 31 px a side[\s\S]*40x30"):
        alex(torch.zeros(30, 40, 3), torch.ones(30, 40, 3))


class Trap:
    def __reduce__(self):
        return (Path.touch, (Path("sprung"),))


def test_a_file_that_would_run_code_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"features.0.weight": Trap()}, tmp_path / "net.pth")
    with pytest.raises(OptionError, match="cannot be read as plain tensors"):
        load_lpips(tmp_path / "net.pth", tmp_path / "net.pth")
    assert not (tmp_path / "sprung").exists()


def test_wrong_files_are_named(tmp_path: Path):
    backbone, linear, _ = weight_files(tmp_path, "alex")
    with pytest.raises(OptionError, match=r"no file with the weights[\s\S]*none\.pth"):
        load_lpips(tmp_path / "none.pth", linear)
    with pytest.raises(OptionError, match=r"lack features\.0\.weight[\s\S]*nothing of that name"):
        load_lpips(linear, linear)
    with pytest.raises(OptionError, match=r"shape \(64, 3, 3, 3\)[\s\S]*shape \(64, 3, 11, 11\)"):
        load_lpips(backbone, linear, network="vgg")
    (tmp_path / "text.pth").write_text("<html>not found</html>")
    with pytest.raises(OptionError, match="cannot be read as plain tensors"):
        load_lpips(tmp_path / "text.pth", linear)
    (tmp_path / "text.safetensors").write_text("{}")
    with pytest.raises(OptionError, match="cannot be read as plain tensors"):
        load_lpips(tmp_path / "text.safetensors", linear)
    with pytest.raises(OptionError, match="use one of alex, vgg"):
        load_lpips(backbone, linear, network="squeeze")
