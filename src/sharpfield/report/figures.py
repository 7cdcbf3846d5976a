"""Plots of the report: camera path, exposures and event rate, losses of training.

Each function returns an SVG element for a page: no background, lines and text in the text colour
of the page, so that it fits a light and a dark one.
"""

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float

from sharpfield.core.capture import Capture
from sharpfield.geometry.space import average_pose

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:  # matplotlib takes half a second to import, which only a figure is worth
    Axes = Figure = Any

INK = "#010203"
"""Replaced by the text colour of the page when the SVG is written."""
TRAIN, TEST, EVENTS = "#c2571a", "#2f7fb8", "#8a8f98"
LINES = ("#2f7fb8", "#c2571a", "#3c9a6b", "#8b62b5", "#b8901f", "#c24a77", "#5f6b7a", "#4aa3a3")

PATH_POINTS = 400
BINS = 240
RATE_SHARE = 0.76
"""Share of the timeline's height for the event rate; exposures are above."""
MS = 1000


def trajectory_figure(capture: Capture) -> str:
    """Camera paths from above and from the side, with exposures and held-out frames."""
    figure, (above, side) = _figure(7.6, 3.4, columns=2)
    paths = _paths(capture)
    middle = np.zeros((0, 3, 4))
    if capture.frames is not None:
        middle = capture.frame_pose(np.arange(len(capture.frames))).double().numpy()
    centre = average_pose(np.concatenate([*paths, middle]))
    held = np.isin(np.arange(len(middle)), capture.split.test)

    def flat(poses: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "n 3"]:
        return (poses[:, :, 3] - centre[:, 3]) @ centre[:, :3]

    for axes, (across, up, sign) in ((above, (0, 2, 1)), (side, (2, 1, -1))):
        for path in paths:
            at = flat(path)
            axes.plot(at[:, across], sign * at[:, up], color=EVENTS, lw=1, zorder=1)
        for exposed in _exposures(capture):
            at = flat(exposed)
            axes.plot(at[:, across], sign * at[:, up], color=TRAIN, lw=4, alpha=0.8, zorder=2)
        at, look = flat(middle), middle[:, :, 2] @ centre[:, :3]
        axes.quiver(
            *(at[:, across], sign * at[:, up], look[:, across], sign * look[:, up]),
            color=INK,
            alpha=0.35,
            width=0.004,
            scale=14,
            zorder=3,
        )
        axes.scatter(at[~held, across], sign * at[~held, up], s=14, color=TRAIN, zorder=4)
        axes.scatter(at[held, across], sign * at[held, up], s=34, marker="D", color=TEST, zorder=5)
        axes.set_aspect("equal", "datalim")
        axes.margins(0.12)
    _name(above, "from above", "right", "forward")
    _name(side, "from the side", "forward", "up")
    return _svg(figure, "path", "Camera path from above and from the side")


def timeline_figure(capture: Capture) -> str | None:
    """Exposures and event rate over time; None if times are made up."""
    frames, events = capture.frames, capture.events
    if events is None and (frames is None or capture.known.motion == "unknown"):
        return None
    figure, (axes,) = _figure(7.6, 1.7, columns=1)
    origin = capture.clock.origin_us
    if events is not None and len(events):
        edges = np.linspace(events.t_us[0], events.t_us[-1] + 1, BINS + 1)
        count = np.diff(np.searchsorted(events.t_us, edges))
        rate = count / (edges[1] - edges[0])  # events per us are millions per second
        axes.fill_between(
            (edges[:-1] - origin) / MS, rate, step="post", color=EVENTS, alpha=0.35, lw=0
        )
        axes.set_ylabel("events, M/s", color=INK, fontsize=8)
        axes.set_ylim(0, max(rate.max(), 1e-9) / RATE_SHARE)
    if frames is not None:
        _shutter(axes, capture)
    axes.set_xlabel("time, ms", color=INK, fontsize=8)
    axes.margins(x=0.01)
    return _svg(figure, "timeline", "Exposures and event rate over time")


def curves_figure(log: Path) -> str | None:
    """Losses, and scores where there are any, over the steps of `log.csv`; None without rows."""
    columns = read_log(log)
    losses = {n: v for n, v in columns.items() if n not in ("step", "seconds") and not _score(n)}
    scores = {name: values for name, values in columns.items() if _score(name)}
    if not columns.get("step"):
        return None
    panels = [kind for kind in (losses, scores) if kind]
    figure, all_axes = _figure(7.6, 2.9, columns=len(panels))
    for axes, panel in zip(all_axes, panels, strict=True):
        for i, (name, values) in enumerate(panel.items()):
            _line(axes, columns["step"], values, name, INK if name == "total" else LINES[i % 8])
        axes.set_xlabel("step", color=INK, fontsize=8)
        axes.legend(frameon=False, fontsize=8, labelcolor=INK, ncols=2 if len(panel) > 4 else 1)
        if panel is losses:
            axes.set_yscale("log")
            axes.set_title("losses", color=INK, fontsize=10, loc="left")
        else:
            axes.set_title("scores during training (PSNR, dB)", color=INK, fontsize=10, loc="left")
    return _svg(figure, "curves", "Losses and scores over the steps of training")


def read_log(path: Path) -> dict[str, list[float | None]]:
    """The columns of `log.csv`, with None where a cell is empty; none if there is no file."""
    if not path.is_file():
        return {}
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = rows[0].keys() if rows else []
    return {name: [float(row[name]) if row[name] else None for row in rows] for name in names}


def _score(name: str) -> bool:
    return name == "validation" or "psnr" in name


def _line(
    axes: Axes, steps: Sequence[float | None], values: Sequence[float | None], name: str, ink: str
) -> None:
    """Plot a curve through the steps that have a value."""
    pairs = [(s, v) for s, v in zip(steps, values, strict=True) if s is not None and v is not None]
    marker = "o" if len(pairs) < 12 else ""
    axes.plot(*zip(*pairs, strict=True), color=ink, lw=1.3, marker=marker, ms=3, label=name)


def _shutter(axes: Axes, capture: Capture) -> None:
    """Bars in the upper part of the plot for exposures, one row for each track."""
    frames, held = capture.needed_frames, set(capture.split.test.tolist())
    start = (frames.exposure.open_us - capture.clock.origin_us) / MS
    end = (frames.exposure.close_us - capture.clock.origin_us) / MS
    gap = 0.0015 * (end.max() - start.min())
    rows = {track: i for i, track in enumerate(np.unique(frames.track).tolist())}
    height = (1 - RATE_SHARE) / (len(rows) + 1)
    for i in range(len(frames)):
        axes.broken_barh(
            [(start[i] + gap, max(end[i] - start[i] - 2 * gap, 2 * gap))],
            (1 - (rows[int(frames.track[i])] + 1) * height, 0.8 * height),
            color=TEST if i in held else TRAIN,
            transform=axes.get_xaxis_transform(),
            lw=0,
        )


def _paths(capture: Capture) -> list[Float[np.ndarray, "n 3 4"]]:
    """Poses along each moving track over its known time span."""
    tracks = np.unique(capture.frames.track) if capture.frames is not None else np.zeros(1, int)
    found = []
    for track in tracks:
        known = capture.trajectory.known_us(int(track))
        if known is not None:
            found.append(_along(capture, np.linspace(*known, PATH_POINTS), int(track)))
    return found


def _exposures(capture: Capture) -> list[Float[np.ndarray, "n 3 4"]]:
    """Poses during each exposure, but for frames taken in one instant."""
    frames = capture.frames
    if frames is None:
        return []
    return [
        _along(
            capture,
            np.linspace(frames.exposure.open_us[i], frames.exposure.close_us[i], 24),
            int(frames.track[i]),
        )
        for i in np.flatnonzero(~frames.exposure.instant)
    ]


def _along(
    capture: Capture, times_us: Float[np.ndarray, "n"], track: int
) -> Float[np.ndarray, "n 3 4"]:
    unit = torch.from_numpy(capture.clock.unit(np.rint(times_us).astype(np.int64))).float()
    tracks = torch.full((len(unit),), track)
    return capture.trajectory.pose(unit, tracks).detach().double().numpy()


def _figure(width: float, height: float, *, columns: int) -> tuple[Figure, list[Axes]]:
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasSVG(figure)
    all_axes = [figure.add_subplot(1, columns, i + 1) for i in range(columns)]
    for axes in all_axes:
        axes.patch.set_visible(False)
        axes.tick_params(colors=INK, labelsize=8)
        axes.grid(color=INK, alpha=0.08)
        for name, spine in axes.spines.items():
            spine.set_visible(name in ("left", "bottom"))
            spine.set_color(INK)
            spine.set_alpha(0.3)
    return figure, all_axes


def _name(axes: Axes, title: str, across: str, up: str) -> None:
    axes.set_title(title, color=INK, fontsize=10, loc="left")
    axes.set_xlabel(f"{across} →", color=INK, fontsize=8)
    axes.set_ylabel(f"{up} →", color=INK, fontsize=8)


def _svg(figure: Figure, name: str, title: str) -> str:
    """The figure as an SVG element, with unique ids so that several fit on one page."""
    import matplotlib

    buffer = io.StringIO()
    # Text stays text, in the page's font; the salt makes the same data give the same page.
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :].replace(INK, "currentColor")
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'(id="|href="#|url\(#)', rf"\1{name}-", text)
    text = re.sub(r'<svg ([^>]*?)width="[^"]*pt" height="[^"]*pt"', r"<svg \1", text, count=1)
    text = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px", text)
    return text.replace("<svg ", f'<svg role="img" aria-label="{title}" ', 1)
