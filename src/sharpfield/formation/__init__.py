"""From a measurement to the sharp rays behind it, and from their light to what is reported."""

from sharpfield.formation.adaptive import AdaptiveWeights
from sharpfield.formation.events import ChainedContrast, LogContrast
from sharpfield.formation.mix import Curve, identity, mix
from sharpfield.formation.response import FixedResponse, LearnedResponse, LogResidual, Response
from sharpfield.formation.rigid_kernel import ORIGIN, RigidKernel, RigidMotions
from sharpfield.formation.shutter import Pinhole, Shutter, expose_at
from sharpfield.formation.sparse_kernel import Bend, SparseKernel, SparsePoints
from sharpfield.formation.threshold import FixedThresholds, LearnedThresholds, Thresholds
from sharpfield.formation.tone import TONES, Tone, gamma, tone_of

__all__ = [
    "ORIGIN",
    "TONES",
    "AdaptiveWeights",
    "Bend",
    "ChainedContrast",
    "Curve",
    "FixedResponse",
    "FixedThresholds",
    "LearnedResponse",
    "LearnedThresholds",
    "LogContrast",
    "LogResidual",
    "Pinhole",
    "Response",
    "RigidKernel",
    "RigidMotions",
    "Shutter",
    "SparseKernel",
    "SparsePoints",
    "Thresholds",
    "Tone",
    "expose_at",
    "gamma",
    "identity",
    "mix",
    "tone_of",
]
