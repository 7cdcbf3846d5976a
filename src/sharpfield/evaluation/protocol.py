"""The protocol: everything that is needed to reproduce the metrics."""

import platform
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy
import torch

import sharpfield
from sharpfield.core.capture import Capture
from sharpfield.evaluation.scores import DEPTH_ERROR, PSNR_ALIGNED, view_metrics
from sharpfield.evaluation.views import Reference
from sharpfield.metrics.lpips import SMALLEST_PX, Lpips
from sharpfield.metrics.registry import Metric

ENABLE_LPIPS = (
    "give torchvision's AlexNet weights (alexnet-owt-7be5be79.pth) and the linear layers of LPIPS"
    " v0.1 (alex.pth, part of the packages lpips and torchmetrics)"
)


def describe_protocol(
    capture: Capture, test: Sequence[Reference], lpips: Lpips | None, *, too_small: bool = False
) -> dict[str, Any]:
    """The part of the protocol that depends on the capture and on the definitions.

    Args:
        capture: The capture that is compared with.
        test: The held-out references.
        lpips: None if it is not computed.
        too_small: LPIPS is not computed because the images are too small for its network.
    """
    frames = capture.frames
    return {
        "capture": capture.name,
        "layout": capture.source,
        "resolution": list(capture.camera.size),
        "encoding": frames.encoding if frames is not None else None,
        "split": {
            "train": len(capture.split.train),
            "test": len(capture.split.test),
            "test_frames": [reference.name for reference in test],
        },
        "references": dict(Counter(reference.kind for reference in test)),
        "why_no_scores": _why_no_scores(capture, test),
        "domain": "display (as stored), 0...1; renders clamped, not quantised",
        "averaging": "mean over views of the number of each view",
        **{one.name: one.definition for one in _defined()},
        "lpips": _lpips(lpips, too_small),
        "pose_refinement": "none",
        "versions": {
            "sharpfield": sharpfield.__version__,
            "torch": torch.__version__,
            "numpy": numpy.__version__,
            "python": platform.python_version(),
        },
    }


def _defined() -> list[Metric]:
    """Metrics of held-out images; those of events have their definitions beside their values."""
    return [*view_metrics().values(), PSNR_ALIGNED, DEPTH_ERROR]


def _why_no_scores(capture: Capture, test: Sequence[Reference]) -> str | None:
    if test:
        return None
    if capture.frames is None:
        return "the capture has no frames to compare with"
    return "the capture holds no frame out"


def _lpips(lpips: Lpips | None, too_small: bool) -> dict[str, Any]:
    if lpips is not None:
        return {"computed": True, "version": "0.1", "network": lpips.network, **lpips.sha256}
    if too_small:
        reason = f"images are smaller than the network allows ({SMALLEST_PX} px)"
        return {"computed": False, "reason": reason, "enable": "evaluate at a larger size"}
    return {"computed": False, "reason": "no weights were given", "enable": ENABLE_LPIPS}
