"""`sharpfield demo`: record a scene, rebuild it by three methods, and compare them."""

from pathlib import Path

from sharpfield.cli.arguments import Device, Size, parse_size


def demo_command(
    out: Path = Path("runs/demo"),
    size: Size = "240x160",
    scene: str = "garden",
    minutes: float = 1.0,
    seed: int = 0,
    device: Device = "auto",
) -> None:
    """Record a scene with a shaky camera, rebuild it sharply, and compare with two baselines.

    Args:
        out: Folder of the run; its report.html shows everything.
        size: Sensor resolution of the simulated camera, WIDTHxHEIGHT.
        scene: Name of a closed-form scene: garden, shelf, tiles or mobile.
        minutes: Training time of each of the three methods.
        seed: Random seed of the recording and of training.
        device: Device to train on.
    """
    from sharpfield.runs.demo import run_demo

    run_demo(out, parse_size(size), scene, minutes, seed, device=device)
