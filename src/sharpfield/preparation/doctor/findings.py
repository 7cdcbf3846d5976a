"""What a checkup says: findings, each with what to do, and what they rest on."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float64, UInt8

Severity = Literal["error", "warning", "note"]
ORDER: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    severity: Severity
    """`error`: training would be misled. `warning`: worth mending. `note`: for the record."""
    check: str
    """Its name, e.g. `polarity-flipped`."""
    what: str
    """One sentence."""
    got: str = ""
    """What was measured."""
    do: str = ""
    """What to do about it."""


@dataclass(frozen=True)
class Curve:
    """A number over something that was tried."""

    title: str
    across: str
    x: Float64[np.ndarray, "k"]
    y: Float64[np.ndarray, "k"]


@dataclass
class Checkup:
    """All that was found, in the order it was looked at."""

    name: str
    findings: list[Finding] = field(default_factory=list[Finding])
    images: dict[str, UInt8[np.ndarray, "h w 3"]] = field(default_factory=dict)
    """By caption."""
    curves: list[Curve] = field(default_factory=list[Curve])

    def say(
        self, severity: Severity, check: str, what: str, *, got: str = "", do: str = ""
    ) -> None:
        """Add a finding."""
        self.findings.append(Finding(severity, check, what, got, do))

    def has(self, severity: Severity) -> bool:
        """Whether there is a finding of a severity."""
        return any(one.severity == severity for one in self.findings)

    @property
    def sorted(self) -> list[Finding]:
        """Findings, the worst first."""
        return sorted(self.findings, key=lambda one: ORDER.index(one.severity))

    @property
    def counts(self) -> dict[str, int]:
        """How many there are of each severity."""
        return {kind: sum(one.severity == kind for one in self.findings) for kind in ORDER}
