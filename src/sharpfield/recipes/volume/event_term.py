"""The event term of the volume recipes: pairs of events, responses, and the contrast error."""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import EventPairs
from sharpfield.core.protocols import Response
from sharpfield.core.rays import Rays
from sharpfield.core.schedule import Group, Schedule
from sharpfield.core.seed import generator
from sharpfield.core.tone import gamma
from sharpfield.events.threshold import FixedThresholds, LearnedThresholds, thresholds_of
from sharpfield.formation.events import LogContrast
from sharpfield.formation.response import FixedResponse, LearnedResponse, LogResidual
from sharpfield.losses.events import BAYER_WEIGHTS, contrast_error
from sharpfield.sampling.pixels_and_pairs import PairTable, draw_pairs, pair_table
from sharpfield.storage.event_cache import event_index


@dataclass(frozen=True)
class EventOptions:
    """The event loss. Defaults: Ev-DeblurNeRF's synthetic recipe."""

    weight: float = 0.1
    """Weight of the event loss; 0 leaves events out."""
    pairs: int = 4096
    """Pairs of successive events per step."""
    threshold: tuple[float, float] | None = None
    """Contrast threshold to darker and to brighter, natural log; None takes that of the capture,
    or 0.2."""
    lr: float | None = None
    """First learning rate of response and thresholds; None takes `lr`."""
    learn_threshold: bool = False
    """Learn one threshold for each polarity; needs frames, as events leave their scale open."""
    response: Literal["linear", "gamma", "learned", "residual"] = "learned"
    """Response of event pixels, before the logarithm: `linear` light; `gamma`, display values;
    `learned`, the published curve (sigmoid of light plus a network); `residual`, log light plus a
    learned function of it that starts at zero."""
    polarity: bool = True
    """Whether a learned response also takes the polarities of the pair as inputs."""
    response_from: int = 1200
    """Iteration from which a learned response is used; linear light before."""
    colour: bool = True
    """Whether events behind a colour filter are compared with their own channel; else with luma."""
    colour_from: int = 1200
    """Iteration after which the channels are weighted 0.4, 0.2, 0.4."""
    accumulate: tuple[int, int] = (0, 0)
    """Least and largest number of events that a pair spans; (0, 0) takes successive events."""
    half_pixel: bool = True
    """Whether rectified positions are measured from pixel centres; the released code measures from
    corners."""


class EventTerm(nn.Module):
    """Pairs of events, the response of the event camera, and the contrast error."""

    def __init__(self, options: EventOptions, capture: Capture, seed: int) -> None:
        super().__init__()
        self.options, self.seed = options, seed
        events = capture.needed_events
        self.table: PairTable = pair_table(
            capture,
            event_index(events),
            successors=max(options.accumulate[0], 0) + 1,
            half_pixel=options.half_pixel,
        )
        self.coloured = options.colour and events.coloured
        self.learned = self._learned_response()
        fixed = FixedResponse(gamma) if options.response == "gamma" else FixedResponse()
        self.early: Response = fixed
        self.camera, self.path = capture.camera, capture.trajectory
        self.guess = thresholds_of(capture, options.threshold)
        kind = LearnedThresholds if options.learn_threshold else FixedThresholds
        self.thresholds = kind(*self.guess)

    def _learned_response(self) -> nn.Module | None:
        options = self.options
        inputs = "light+polarity" if options.polarity else "light"
        if options.response == "learned":
            return LearnedResponse(inputs=inputs)
        if options.response == "residual":
            return LogResidual(inputs=inputs, generator=generator(self.seed, 0, "response"))
        return None

    def draw(self, step: int, device: torch.device) -> EventPairs:
        """Random pairs of events of a step."""
        seen = draw_pairs(
            self.table,
            self.options.pairs,
            seed=self.seed,
            step=step,
            accumulate=self.options.accumulate,
            device=device,
        )
        return seen if self.coloured else _mono(seen)

    def sensor(self, step: int) -> LogContrast:
        """The event sensor with the response of a step."""
        late = self.learned is not None and step + 1 >= self.options.response_from
        response = self.learned if late and self.learned is not None else self.early
        return LogContrast(self.camera, self.path, response)

    def expose(self, seen: EventPairs) -> Rays:
        """Rays at both instants of each pair."""
        return self.sensor(0).expose(seen)

    def error(
        self, predicted: Float[Tensor, "b 1"], seen: EventPairs, step: int
    ) -> Float[Tensor, ""]:
        """Mean squared error of the change of log intensity (Ev-DeblurNeRF, event loss)."""
        weigh = self.coloured and step + 1 > self.options.colour_from
        return contrast_error(
            predicted,
            seen.measured(*self.thresholds(seen)),
            channel=seen.channel,
            weights=BAYER_WEIGHTS if weigh else None,
        )

    def prior(self) -> Float[Tensor, ""] | None:
        """Penalty of learned thresholds far from their first values; None if they are fixed."""
        return self.thresholds.prior() if isinstance(self.thresholds, LearnedThresholds) else None

    def groups(self, rate: Schedule) -> list[Group]:
        """Parameters of response and thresholds with their learning rate."""
        return [Group("response", own, rate)] if (own := tuple(self.parameters())) else []


def _mono(seen: EventPairs) -> EventPairs:
    """The same pairs without colour channels."""
    return replace(seen, channel=None)
