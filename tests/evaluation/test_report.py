import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.capture import Known, Split
from sharpfield.core.events import merged
from sharpfield.core.protocols import Paper
from sharpfield.evaluation import report
from sharpfield.evaluation.measure import EvaluationOptions, evaluate
from sharpfield.evaluation.report import RunDescription, flat, input_name, write_report
from sharpfield.report.capture import capture_section
from sharpfield.report.page import ImageEncoding
from tests.evaluation.fake import Sky, capture

PAPER = Paper("key2024", "A method & more", "@inproceedings{key2024}", ("It is <better>.",))
STORY = RunDescription("the sky", PAPER, {"seed": 0, "volume": {"samples": (64, 64)}})


class Checker(HTMLParser):
    """Notes what a page refers to, and whether its tags match."""

    VOID = frozenset(("meta", "img", "input", "br", "use", "path"))

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []
        self.ids: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.text = ""
        self.scripts = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.scripts += tag == "script"
        self.references += [v or "" for k, v in attrs if k in ("src", "href", "xlink:href")]
        self.ids += [values["id"] or ""] if "id" in values else []
        if tag == "img":
            self.images.append(values)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in ("style", "script"):
            self.text += data


def checked(path: Path) -> Checker:
    checker = Checker()
    checker.feed(path.read_text(encoding="utf-8"))
    assert checker.open == []
    assert all(r.startswith(("data:image/", "data:video/", "#")) for r in checker.references)
    assert len(checker.ids) == len(set(checker.ids))
    assert all(image["alt"] for image in checker.images)
    assert path.stat().st_size < report.LARGEST_BYTES
    return checker


def test_a_whole_run_is_told(tmp_path: Path):
    (tmp_path / "training.json").write_text('{"steps": 70, "seconds": 150, "peak_memory_mb": 512}')
    (tmp_path / "log.csv").write_text("step,seconds,total,validation\n19,1,0.5,\n39,2,0.3,21\n")
    other = evaluate(Sky(capture(), gain=0.5), capture(), tmp_path / "baselines" / "nerf")
    baselines = {"nerf": {"mean": other["mean"], "run": "baselines/nerf"}}
    metrics = evaluate(Sky(capture()), capture(), tmp_path, baselines=baselines)
    path = write_report(tmp_path, capture(), metrics, STORY)
    assert path == tmp_path / "report.html"
    told = checked(path)
    # 4 training views of 6 images and their baseline, 2 held-out ones of 4, 3 frames, events
    assert len(told.images) == 4 * 6 + 2 * 5 + 3 + 1
    for text in (
        f"{metrics['mean']['psnr']:.2f} dB",
        "LPIPS was not computed",
        "nerf",
        "2.5 min",
        "512 MB",
        "It is <better>.",
        "A method & more",
        "@inproceedings{key2024}",
        "volume.samples",
        "64, 64",
        "500 in",
    ):
        assert text in told.text, text


@pytest.mark.parametrize(
    ("lacking", "text"),
    [
        (capture(test=()), "No held-out scores: the capture holds no frame out."),
        (capture(truth=False), "mean over 2 held-out views"),
        (capture(events=0), "without"),
        (capture().without(frames=True), "No held-out scores: the capture has no frames"),
    ],
)
def test_what_a_capture_lacks_is_left_out(tmp_path: Path, lacking, text: str):
    metrics = evaluate(Sky(lacking), lacking, tmp_path)
    told = checked(write_report(tmp_path, lacking, metrics, RunDescription("odd")))
    assert text in told.text or text == "without"
    assert "brighter" in told.text or lacking.events is None


def test_frames_are_called_blurry_only_if_they_may_be():
    sharp = replace(capture(), split=Split(np.array([0, 4]), np.array([1])))
    assert input_name(capture()) == "blurry input"
    assert input_name(sharp) == "input"
    assert input_name(replace(sharp, known=Known(motion="unknown"))) == "blurry input"


def test_a_gain_over_the_blurry_input_is_told_only_where_it_is_blurry(tmp_path: Path):
    sharp = replace(capture(), split=Split(np.array([0, 4]), np.array([1])))
    for one, told in ((capture(), True), (sharp, False)):
        metrics = evaluate(Sky(one), one, tmp_path)
        page_text = checked(write_report(tmp_path, one, metrics, RunDescription("input"))).text
        assert ("over the blurry input" in page_text) == told


def test_events_are_shown_of_the_camera_whose_frame_is_shown():
    one, events = capture(), capture().needed_events
    other = replace(events, x=events.width - 1 - events.x)
    pair = [
        replace(part, track=np.full(len(part), k, np.int16), tracks=2)
        for k, part in enumerate((events, other))
    ]
    alone, rig = (capture_section(of).images[1] for of in (one, replace(one, events=merged(pair))))
    np.testing.assert_array_equal(rig.pixels, alone.pixels)


def test_events_alone_are_said_to_be_aligned(tmp_path: Path):
    blind = capture().without(frames=True)
    metrics = evaluate(Sky(blind), capture(), tmp_path, options=EvaluationOptions(train_views=1))
    told = checked(write_report(tmp_path, capture(), metrics, RunDescription("blind")))
    assert "aligned to the references" in told.text


def test_metrics_from_the_file_make_the_same_page(tmp_path: Path):
    metrics = evaluate(Sky(capture()), capture(), tmp_path)
    first = write_report(tmp_path, capture(), metrics, STORY).read_bytes()
    read = json.loads((tmp_path / "metrics.json").read_text())
    assert write_report(tmp_path, capture(), read, STORY).read_bytes() == first


def test_a_page_over_budget_gets_smaller_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    metrics = evaluate(Sky(capture()), capture(), tmp_path)
    large = write_report(tmp_path, capture(), metrics, STORY).stat().st_size
    monkeypatch.setattr(report, "ENCODINGS", (ImageEncoding(40, 90), ImageEncoding(20, 30)))
    monkeypatch.setattr(report, "LARGEST_BYTES", large - 1000)
    assert write_report(tmp_path, capture(), metrics, STORY).stat().st_size < large - 1000


def test_nested_settings_get_dotted_names():
    assert flat({"a": 1, "b": {"c": (1, 2), "d": {"e": None}, "f": ()}}) == {
        "a": 1,
        "b.c": "1, 2",
        "b.d.e": None,
        "b.f": "none",
    }


def test_hostile_names_stay_text_in_the_report_of_a_run(tmp_path: Path):
    hostile = "\"'><script>alert(1)</script>"
    one = capture()
    frames = replace(one.needed_frames, names=tuple(f"{hostile}{i}" for i in range(6)))
    named = replace(one, name=hostile, source=hostile, frames=frames)
    metrics = evaluate(
        Sky(named), named, tmp_path, baselines={hostile: {"mean": {"psnr": 20.0, "ssim": 0.5}}}
    )
    paper = Paper(hostile, hostile, hostile, (hostile,))
    about = RunDescription(hostile, paper, {hostile: hostile})
    told = checked(write_report(tmp_path, named, metrics, about))
    assert told.scripts == 1, "only our own"
    assert told.text.count(hostile) > 20
    # the table of methods, the title and the heading, and the settings
    for text in (f"{hostile}20.00", f"{hostile}{hostile}"):
        assert text in told.text
