"""A run as one HTML file: what was captured, what came out, how good it is, how it was made.

The page needs no server and no network: images, drawings, style and script are inside it. It
reads the images that `evaluate` wrote to `RUN/renders/`, and the losses in `RUN/log.csv`.

The images of the report that are compared with each other.
"""

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.core.files import replacing
from sharpfield.core.paper import Paper
from sharpfield.core.seed import evenly_spread
from sharpfield.core.tone import luma
from sharpfield.evaluation.event_videos import events_section
from sharpfield.evaluation.views import SHARP, TRUTH, Reference, held_out, trained_on
from sharpfield.report import page
from sharpfield.report.capture import captured
from sharpfield.report.colormaps import ERROR_WHITE, colour_error, eight_bit
from sharpfield.report.figures import curves_figure
from sharpfield.report.page import Colours, Image, Look, View, section
from sharpfield.report.tables import as_html, methods_table, number, views_table
from sharpfield.storage.images import read_image

VIEWS = 4
"""Most views of a kind to show; the tables have them all."""

BLURRY, SHARP_INPUT = "blurry input", "input"
RESULT, STORED, ERROR, DEPTH = "result", "stored image", "error", "depth"


def input_name(capture: Capture) -> str:
    """What to call recorded frames: blurry if they were, or may have been, exposed for a while."""
    frames = capture.frames
    lasting = frames is not None and not frames.exposure.instant[capture.split.train].all()
    return BLURRY if lasting or capture.known.motion == "unknown" else SHARP_INPUT


def compared_views(
    run: Path, capture: Capture, metrics: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]
) -> list[View]:
    """Views with their input, result, baselines, truth, error and depth, as far as there are.

    Args:
        run: Where the images lie.
        capture: Gives inputs and references.
        metrics: Names the baselines, and the folders of their renders.
        rows: Views of `metrics.json`; some are chosen if there are many.
    """
    known = {one.frame: one for one in [*held_out(capture), *trained_on(capture)]}
    others = {
        name: run / other["run"]
        for name, other in metrics.get("baselines", {}).items()
        if "run" in other
    }
    chosen = [rows[i] for i in evenly_spread(np.arange(len(rows)), VIEWS)]
    return [
        _view(run, row, known[row["frame"]], others, input_name(capture))
        for row in chosen
        if row["frame"] in known and (run / row["image"]).is_file()
    ]


def _view(
    run: Path,
    row: Mapping[str, Any],
    reference: Reference,
    others: Mapping[str, Path],
    recorded: str,
) -> View:
    result = read_image(run / row["image"])
    images = []
    if reference.kind in (TRUTH, ""):
        measured = eight_bit(reference.measured.numpy())
        images.append(_image(recorded, measured, reference.name, row.get("input")))
    images.append(_image(RESULT, result, reference.name, row))
    for name, folder in others.items():
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
    return View(reference.name, tuple(images))


def _image(kind: str, pixels: Colours, name: str, scores: Mapping[str, Any] | None = None) -> Image:
    known = scores is not None and scores.get("psnr") is not None
    caption = f"{kind}, {number('psnr', scores or {})} dB" if known else kind
    return Image(kind, pixels, caption, f"{kind} of view {name}")


REPORT = "report.html"
BUDGET_BYTES = 6_000_000
LOOKS = (Look(960, 88), Look(720, 80), Look(480, 72), Look(320, 60))
"""Tried in turn until the page fits its budget."""


@dataclass(frozen=True)
class Story:
    """What the page says besides the capture and the metrics."""

    title: str
    paper: Paper | None = None
    """Of the recipe: its departures, and how to cite it."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Everything that was chosen, nested as it comes; shown as a table."""


def write_report(run: Path, capture: Capture, metrics: Mapping[str, Any], story: Story) -> Path:
    """Write `RUN/report.html`.

    Args:
        run: Folder with `renders/` and `log.csv`; parts that are missing are left out.
        capture: What `evaluate` compared with.
        metrics: What `evaluate` returned.
        story: Title, settings, paper.

    Returns:
        The file. It is smaller than `BUDGET_BYTES` unless not even small images fit.
    """
    written = ""
    for look in LOOKS:
        written = page.page(story.title, _body(run, capture, metrics, story, look))
        if len(written.encode()) <= BUDGET_BYTES:
            break
    with replacing(run / REPORT) as temporary:
        temporary.write_text(written, encoding="utf-8")
    return run / REPORT


def _body(run: Path, capture: Capture, metrics: Mapping[str, Any], story: Story, look: Look) -> str:
    train = compared_views(run, capture, metrics, metrics["train_views"]["views"])
    test = compared_views(run, capture, metrics, metrics["views"])
    recorded = input_name(capture)
    parts = [
        _header(metrics, story, recorded=recorded),
        _result(train, test, metrics, look, recorded=recorded),
        events_section(run, metrics),
        captured(capture, look),
        _numbers(metrics),
        _training(run, metrics),
        _protocol(metrics),
        _settings(story),
        _paper(story),
        _footer(metrics),
    ]
    return "\n".join(part for part in parts if part)


def _header(metrics: Mapping[str, Any], story: Story, *, recorded: str) -> str:
    method = story.paper.title if story.paper is not None else ""
    cards = page.cards(_headline(metrics, recorded))
    return (
        f'<header>\n<p class="eyebrow">sharpfield</p>\n<h1>{html.escape(story.title)}</h1>\n'
        f'<p class="subtitle">{html.escape(method)}</p>\n{cards}\n'
        f"{_lpips_note(metrics['protocol']['lpips'])}</header>"
    )


def _headline(metrics: Mapping[str, Any], recorded: str) -> list[tuple[str, str, str]]:
    """Value, name and remark of the numbers one looks for first."""
    mean, cost, count = metrics["mean"], metrics["train"], len(metrics["views"])
    found = []
    if mean["psnr"] is not None:
        views = f"mean over {count} held-out view{'s' * (count != 1)}"
        found.append((f"{mean['psnr']:.2f} dB", "PSNR", views))
        printed = f"{number('ssim_paper', mean)} as papers print it"
        found.append((number("ssim", mean), "SSIM", printed))
    if mean["lpips"] is not None:
        found.append((number("lpips", mean), "LPIPS", metrics["protocol"]["lpips"]["network"]))
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


def _lpips_note(lpips: Mapping[str, Any]) -> str:
    if lpips["computed"]:
        return ""
    return (
        f'<p class="note"><strong>LPIPS was not computed:</strong> {html.escape(lpips["reason"])}.'
        f" To have it, {html.escape(lpips['enable'])}.</p>\n"
    )


def _result(
    train: Sequence[View],
    test: Sequence[View],
    metrics: Mapping[str, Any],
    look: Look,
    *,
    recorded: str,
) -> str:
    legend = (
        f'<p class="scale">error (mean absolute, display values) 0 <i></i> {ERROR_WHITE:g} and more'
        "</p>"
    )
    parts = []
    if train:
        parts.append("<h3>What the camera recorded, and the scene at mid-exposure</h3>")
        worst = _blurriest(train, metrics)
        parts.append(page.comparison(train, look, left=recorded, right=RESULT, first=worst))
    if test:
        right = TRUTH if TRUTH in [p.kind for p in test[0].images] else STORED
        parts.append("<h3>Held-out views, which training never saw</h3>")
        parts.append(page.comparison(test, look, left=RESULT, right=right))
    alignment = metrics["protocol"]["alignment"]
    if parts and alignment is not None:
        parts.append(
            '<p class="note">Events alone do not tell brightness: the result was aligned to the'
            " references by one line per channel in log intensity.</p>"
        )
    return section(
        "The result",
        *parts,
        legend if parts else "",
        intro="Drag the line, or use the arrow keys. Choose any two images to compare.",
    )


def _blurriest(views: Sequence[View], metrics: Mapping[str, Any]) -> str:
    """The shown view whose input is farthest from its truth; "" if no truth is known."""
    shown = {view.name for view in views}
    rows = metrics["train_views"]["views"]
    known = [row for row in rows if "input" in row and row["name"] in shown]
    return min(known, key=lambda row: row["input"]["psnr"])["name"] if known else ""


def _numbers(metrics: Mapping[str, Any]) -> str:
    """Methods side by side, then each view."""
    protocol, learned = metrics["protocol"], metrics["train_views"]
    parts = []
    if metrics["mean"]["psnr"] is None:
        why = protocol["why_no_scores"] or "there is no image to compare with"
        parts.append(f'<p class="note">No held-out scores: {html.escape(why)}.</p>')
    elif metrics.get("baselines"):
        parts += ["<h3>Beside other methods, held-out views</h3>", as_html(methods_table(metrics))]
    if metrics["views"]:
        table = as_html(views_table(metrics["views"], metrics["mean"]))
        parts.append(page.folded_if_long("Held-out views", table, len(metrics["views"])))
    if "blurred image" in protocol["references"]:
        parts.append(
            '<p class="note">Some held-out frames are blurred themselves and their sharp truth is'
            " unknown: a sharp render scores badly there.</p>"
        )
    if learned["count"]:
        before = learned["input"]["mean"]
        table = as_html(views_table(learned["views"], learned["mean"], input_mean=before))
        title = "Training views, against their sharp truth"
        parts.append(page.folded_if_long(title, table, learned["count"]))
    return section("Numbers", *parts)


def _training(run: Path, metrics: Mapping[str, Any]) -> str:
    cost = metrics["train"]
    facts: dict[str, object] = {}
    if cost["seconds"] is not None:
        facts["time"] = _duration(float(cost["seconds"]))
        if cost["steps"]:
            each = 1000 * cost["seconds"] / cost["steps"]
            facts["steps"] = f"{cost['steps']:,}, {each:.3g} ms each"
    if cost["peak_memory_mb"]:
        facts["most memory"] = f"{cost['peak_memory_mb']:,.0f} MB"
    views = [*metrics["views"], *metrics["train_views"]["views"]]
    if views:
        mean = sum(view["seconds"] for view in views) / len(views)
        facts["rendering"] = f"{mean:.3g} s for a view of {_size(metrics)} px"
    curves = page.drawing(curves_figure(run / "log.csv"), "From log.csv; losses are means of rows.")
    return section("Training", page.definitions(facts), curves)


def _protocol(metrics: Mapping[str, Any]) -> str:
    told = {name: value for name, value in flat(metrics["protocol"]).items() if value is not None}
    return section(
        "How it was measured",
        page.folded("The protocol of every number above", page.definitions(told)),
    )


def _settings(story: Story) -> str:
    table = page.folded("All settings", page.definitions(flat(story.settings)))
    return section("How to get it again", table)


def _paper(story: Story) -> str:
    if story.paper is None:
        return ""
    items = "".join(f"<li>{html.escape(one)}</li>" for one in story.paper.departures)
    departures = f"<h3>Where this differs from the published code</h3><ul>{items}</ul>"
    return section(
        "The method",
        f"<p>{html.escape(story.paper.title)}</p>",
        f"<pre>{html.escape(story.paper.bibtex)}</pre>",
        departures if items else "",
    )


def _footer(metrics: Mapping[str, Any]) -> str:
    versions = metrics["protocol"]["versions"]
    told = ", ".join(f"{name} {version}" for name, version in versions.items())
    return f"<footer>{html.escape(told)}. This page is one file and loads nothing.</footer>"


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


def _size(metrics: Mapping[str, Any]) -> str:
    width, height = metrics["protocol"]["resolution"]
    return f"{width}×{height}"


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.3g} s"
    if seconds < 7200:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h"
