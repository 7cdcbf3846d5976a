"""The result of a checkup: findings, each with what to do, and their evidence."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float64, UInt8

Severity = Literal["error", "warning", "note"]
ORDER: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    severity: Severity
    """`error`: training would fail or give wrong results. `warning`: worth fixing. `note`: for the
    record."""
    check: str
    """Name of the finding, such as `polarity-flipped`."""
    what: str
    """The finding in one sentence."""
    got: str = ""
    """Measured values."""
    do: str = ""
    """How to fix it."""


@dataclass(frozen=True)
class MeasuredCurve:
    """A measured value over a parameter."""

    title: str
    x_label: str
    x: Float64[np.ndarray, "k"]
    y: Float64[np.ndarray, "k"]


@dataclass
class Checkup:
    """All findings of a capture, in the order of the checks."""

    name: str
    findings: list[Finding] = field(default_factory=list[Finding])
    images: dict[str, UInt8[np.ndarray, "h w 3"]] = field(default_factory=dict)
    """Images by caption."""
    curves: list[MeasuredCurve] = field(default_factory=list[MeasuredCurve])

    def add(
        self, severity: Severity, check: str, what: str, *, got: str = "", do: str = ""
    ) -> None:
        """Add a finding."""
        self.findings.append(Finding(severity, check, what, got, do))

    def has(self, severity: Severity) -> bool:
        """Whether there is a finding of this severity."""
        return any(one.severity == severity for one in self.findings)

    @property
    def sorted(self) -> list[Finding]:
        """Findings, the most severe first."""
        return sorted(self.findings, key=lambda one: ORDER.index(one.severity))

    @property
    def counts(self) -> dict[str, int]:
        """Number of findings of each severity."""
        return {kind: sum(one.severity == kind for one in self.findings) for kind in ORDER}
