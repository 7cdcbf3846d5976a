"""Options of evaluation, apart from what they do, so that reading them is quick."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Refinement:
    """How poses are refined. Published: 5000 steps; rate 1e-5 for synthetic scenes."""

    steps: int = 500
    """Steps of gradient descent."""
    pixels: int = 300
    """Random pixels of each view and step."""
    rate: float = 1e-4
    """Learning rate of the twists, in rad and units of the model's space."""
    every: int = 100
    """Steps between full renders, which the best pose of each view is chosen by; 0 takes the pose
    after the last step."""
    hard_psnr: float = 19.0
    """Views with a PSNR below this (dB) sample pixels in proportion to their squared error."""
    rays: int = 4096
    """Most rays rendered at once."""
