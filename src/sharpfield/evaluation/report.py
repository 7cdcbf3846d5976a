"""A run as one HTML file: what was captured, the result, its metrics, and how it was made.

The page needs no server and no network: images, drawings, style and script are inside it. It
reads the images that `evaluate` wrote to `RUN/renders/`, and the losses in `RUN/log.csv`. The
markup is in `report/templates/run.html.j2`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.core.files import replacing
from sharpfield.core.protocols import Paper
from sharpfield.core.seed import evenly_spread
from sharpfield.core.tone import luma
from sharpfield.evaluation.event_scores import events_section
from sharpfield.evaluation.scores import methods_table, reported_metrics, view_metrics, views_table
from sharpfield.evaluation.views import SHARP, TRUTH, Reference, held_out, trained_on
from sharpfield.report.capture import capture_section
from sharpfield.report.colormaps import ERROR_WHITE, colour_error, eight_bit
from sharpfield.report.figures import curves_figure
from sharpfield.report.page import CaptionedImage, ComparedView, ImageEncoding, Pixels, render_page
from sharpfield.storage.images import read_image

REPORT = "report.html"
LARGEST_BYTES = 6_000_000
ENCODINGS = (
    ImageEncoding(960, 88),
    ImageEncoding(720, 80),
    ImageEncoding(480, 72),
    ImageEncoding(320, 60),
)
"""Tried in turn until the page is small enough."""

VIEWS = 4
"""Most views of a kind to show; the tables have them all."""

BLURRY, SHARP_INPUT = "blurry input", "input"
RESULT, STORED, ERROR, DEPTH = "result", "stored image", "error", "depth"


@dataclass(frozen=True)
class RunDescription:
    """What the page states besides the capture and the metrics."""

    title: str
    """Heading of the page."""
    paper: Paper | None = None
    """Paper of the recipe: departures, and how to cite it."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the run, nested; shown as a table with dotted names."""


def write_report(
    run: Path, capture: Capture, metrics: Mapping[str, Any], about: RunDescription
) -> Path:
    """Write `RUN/report.html`.

    Args:
        run: Folder with `renders/` and `log.csv`; parts that are missing are left out.
        capture: What `evaluate` compared with.
        metrics: What `evaluate` returned.
        about: Title, settings, paper.

    Returns:
        The file. It is smaller than `LARGEST_BYTES` unless not even small images fit.
    """
    values, text = _values(run, capture, metrics, about), ""
    for encoding in ENCODINGS:
        text = render_page("run.html.j2", {**values, "encoding": encoding})
        if len(text.encode()) <= LARGEST_BYTES:
            break
    with replacing(run / REPORT) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return run / REPORT


def input_name(capture: Capture) -> str:
    """What to call recorded frames: blurry if they were, or may have been, exposed for a while."""
    frames = capture.frames
    exposed = frames is not None and not frames.exposure.instant[capture.split.train].all()
    return BLURRY if exposed or capture.known.motion == "unknown" else SHARP_INPUT


def compared_views(
    run: Path, capture: Capture, metrics: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]
) -> list[ComparedView]:
    """Views with input, result, baselines, truth, error and depth, as far as there are any.

    Args:
        run: Folder of the images.
        capture: Gives inputs and references.
        metrics: Names the baselines, and the folders of their renders.
        rows: Views of `metrics.json`; some are chosen if there are many.
    """
    references = {one.frame: one for one in [*held_out(capture), *trained_on(capture)]}
    baselines = {
        name: run / other["run"]
        for name, other in metrics.get("baselines", {}).items()
        if "run" in other
    }
    chosen = [rows[i] for i in evenly_spread(np.arange(len(rows)), VIEWS)]
    return [
        _compared_view(run, row, references[row["frame"]], baselines, input_name(capture))
        for row in chosen
        if row["frame"] in references and (run / row["image"]).is_file()
    ]


def _compared_view(
    run: Path,
    row: Mapping[str, Any],
    reference: Reference,
    baselines: Mapping[str, Path],
    recorded: str,
) -> ComparedView:
    result = read_image(run / row["image"])
    images = []
    if reference.kind in (TRUTH, ""):
        measured = eight_bit(reference.measured.numpy())
        images.append(_image(recorded, measured, reference.name, row.get("input")))
    images.append(_image(RESULT, result, reference.name, row))
    for name, folder in baselines.items():
        if (folder / row["image"]).is_file():
            images.append(_image(name, read_image(folder / row["image"]), reference.name))
    if reference.image is not None:
        kind = TRUTH if reference.kind in (TRUTH, SHARP) else STORED
        images.append(_image(kind, eight_bit(reference.image.numpy()), reference.name))
        grey = result.shape[-1] < reference.image.shape[-1]
        truth = luma(reference.image)[..., None] if grey else reference.image
        error = colour_error(result.astype(np.float32) / 255, truth.numpy())
        images.append(_image(ERROR, error, reference.name))
    if (run / row["depth"]).is_file():
        images.append(_image(DEPTH, read_image(run / row["depth"]), reference.name))
    return ComparedView(reference.name, tuple(images))


def _image(
    kind: str, pixels: Pixels, name: str, scores: Mapping[str, Any] | None = None
) -> CaptionedImage:
    value = None if scores is None else scores.get("psnr")
    caption = kind if value is None else f"{kind}, {view_metrics()['psnr'].text(value)} dB"
    return CaptionedImage(kind, pixels, caption, f"{kind} of view {name}")


def _values(
    run: Path, capture: Capture, metrics: Mapping[str, Any], about: RunDescription
) -> dict[str, Any]:
    """The variables of the template, but for the encoding of images."""
    train = compared_views(run, capture, metrics, metrics["train_views"]["views"])
    test = compared_views(run, capture, metrics, metrics["views"])
    recorded, protocol = input_name(capture), metrics["protocol"]
    kinds = [image.kind for view in test[:1] for image in view.images]
    stated = {name: value for name, value in flat(protocol).items() if value is not None}
    return {
        "title": about.title,
        "method": about.paper,
        "headline": _headline(metrics, recorded),
        "lpips": protocol["lpips"],
        "train": train,
        "test": test,
        "recorded": recorded,
        "blurriest": _blurriest(train, metrics),
        "test_reference": TRUTH if TRUTH in kinds else STORED,
        "aligned": protocol["alignment"] is not None,
        "error_white": f"{ERROR_WHITE:g}",
        "events": events_section(run, metrics),
        "capture": capture_section(capture),
        **_tables(metrics),
        "training": _training(metrics),
        "curves": curves_figure(run / "log.csv"),
        "protocol": stated,
        "settings": flat(about.settings),
        "versions": ", ".join(f"{name} {value}" for name, value in protocol["versions"].items()),
    }


def _headline(metrics: Mapping[str, Any], recorded: str) -> list[tuple[str, str, str]]:
    """Value, name and remark of the most important numbers."""
    mean, cost, count = metrics["mean"], metrics["train"], len(metrics["views"])
    known = view_metrics()
    found = []
    if mean["psnr"] is not None:
        views = f"mean over {count} held-out view{'s' * (count != 1)}"
        found.append((f"{known['psnr'].text(mean['psnr'])} dB", "PSNR", views))
        paper = f"{known['ssim_paper'].text(mean['ssim_paper'])} as papers print it"
        found.append((known["ssim"].text(mean["ssim"]), "SSIM", paper))
    if mean["lpips"] is not None:
        network = metrics["protocol"]["lpips"]["network"]
        found.append((known["lpips"].text(mean["lpips"]), "LPIPS", network))
    after = metrics["train_views"]["mean"]["psnr"]
    before = metrics["train_views"]["input"]["mean"]["psnr"]
    if recorded == BLURRY and after is not None and before is not None:
        remark = f"training views, {before:.2f} → {after:.2f}"
        found.append((f"{after - before:+.2f} dB", f"over the {recorded}", remark))
    if cost["seconds"] is not None:
        memory = cost["peak_memory_mb"]
        remark = f"{cost['steps']:,} steps" + (f", {memory / 1024:.1f} GiB" if memory else "")
        found.append((_duration(float(cost["seconds"])), "of training", remark))
    return found


def _blurriest(views: Sequence[ComparedView], metrics: Mapping[str, Any]) -> str:
    """The shown view whose input has the lowest PSNR; "" if no truth is known."""
    shown = {view.name for view in views}
    rows = metrics["train_views"]["views"]
    known = [row for row in rows if "input" in row and row["name"] in shown]
    return min(known, key=lambda row: row["input"]["psnr"])["name"] if known else ""


def _tables(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Methods side by side, then each view."""
    protocol, learned, mean = metrics["protocol"], metrics["train_views"], metrics["mean"]
    baselines = metrics.get("baselines")
    further = [name for name in reported_metrics() if mean.get(name) is not None]
    further = [name for name in further if name not in view_metrics()]
    no_scores = protocol["why_no_scores"] or "there is no image to compare with"
    return {
        "no_scores": no_scores if mean["psnr"] is None else "",
        "methods": methods_table(metrics) if baselines or further else None,
        "methods_title": f"{'Beside other methods' if baselines else 'Means'}, held-out views",
        "test_table": views_table(metrics["views"], mean) if metrics["views"] else None,
        "test_count": len(metrics["views"]),
        "blurred_references": "blurred image" in protocol["references"],
        "train_table": views_table(
            learned["views"], learned["mean"], input_mean=learned["input"]["mean"]
        )
        if learned["count"]
        else None,
        "train_count": learned["count"],
    }


def _training(metrics: Mapping[str, Any]) -> dict[str, object]:
    """Time, steps and memory, and the time to render a view."""
    cost = metrics["train"]
    facts: dict[str, object] = {}
    if cost["seconds"] is not None:
        facts["time"] = _duration(float(cost["seconds"]))
        if cost["steps"]:
            each = 1000 * cost["seconds"] / cost["steps"]
            facts["steps"] = f"{cost['steps']:,}, {each:.{0 if each >= 100 else 1}f} ms each"
    if cost["peak_memory_mb"]:
        facts["peak memory"] = f"{cost['peak_memory_mb']:,.0f} MB"
    views = [*metrics["views"], *metrics["train_views"]["views"]]
    if views:
        mean = sum(view["seconds"] for view in views) / len(views)
        width, height = metrics["protocol"]["resolution"]
        facts["rendering"] = f"{mean:.3g} s for a view of {width}×{height} px"
    if (poses := metrics.get("poses")) is not None:
        off = poses["absolute"]
        facts["training poses"] = (
            f"{off['translation']:.3g} units and {off['rotation_deg']:.3g}° from the capture's (RMS"
            " after the best similarity)"
        )
    return facts


def flat(nested: Mapping[str, Any], before: str = "") -> dict[str, object]:
    """Nested settings under dotted names, in their order."""
    found: dict[str, object] = {}
    for name, value in nested.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{before}{name}.")
        elif isinstance(value, list | tuple):
            found[before + name] = ", ".join(map(str, value)) or "none"
        else:
            found[before + name] = value
    return found


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.3g} s"
    if seconds < 7200:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h"
