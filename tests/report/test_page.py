"""Pages: everything is escaped, nothing is loaded from elsewhere."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest
from jinja2 import UndefinedError

from sharpfield.report.page import (
    CaptionedImage,
    ComparedView,
    ImageEncoding,
    TextTable,
    _environment,
    data_url,
    render_page,
)

HOSTILE = "\"'><script>alert(1)</script>&{{ title }}"
ENCODING = ImageEncoding(40, 80)
PIXELS = np.zeros((4, 6, 3), np.uint8)

POSES = {
    "title": "poses",
    "heading": "garden",
    "subtitle": "From frames",
    "cards": [("3", "images", "")],
    "flat": None,
    "failures": None,
    "views": [],
    "trajectory": "<svg></svg>",
    "images": TextTable(("frame", "error"), (("01", "0.2"),)),
    "encoding": ENCODING,
}


class Texts(HTMLParser):
    """Collects the text, the attributes and the tags of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.attributes: list[str] = []
        self.tags: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [value or "" for _, value in attrs]

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def test_hostile_names_stay_text():
    image = CaptionedImage(HOSTILE, PIXELS, HOSTILE, HOSTILE)
    table = TextTable((HOSTILE, HOSTILE), ((HOSTILE, HOSTILE),))
    values = POSES | {
        "title": HOSTILE,
        "heading": HOSTILE,
        "subtitle": HOSTILE,
        "cards": [(HOSTILE, HOSTILE, HOSTILE)],
        "flat": table,
        "failures": table,
        "images": table,
        "views": [ComparedView(HOSTILE, (image,))],
    }
    found = Texts(render_page("poses.html.j2", values))
    assert found.tags.count("script") == 1, "only our own"
    # title, heading, subtitle, a card, a caption, and four cells of each of three tables
    assert found.texts.count(HOSTILE) == 3 + 3 + 1 + 3 * 4
    assert found.attributes.count(HOSTILE) == 3, "view, kind of image, alternative text"


def test_a_finding_with_a_hostile_name_stays_text():
    finding = dict.fromkeys(("check", "what", "got", "do"), HOSTILE) | {"severity": "error"}
    plot = {"title": HOSTILE, "width": 3, "height": 2, "axes": "M0,0", "points": "0,0"}
    values = {
        "title": "x",
        "heading": HOSTILE,
        "verdict": HOSTILE,
        "cards": [],
        "findings": [finding],
        "narrow_images": [],
        "wide_images": [],
        "curves": [plot | {"labels": [(0, 0, "end", HOSTILE)]}],
        "capture": None,
        "encoding": ENCODING,
    }
    found = Texts(render_page("doctor.html.j2", values))
    assert found.tags.count("script") == 1
    assert sum(HOSTILE in text for text in found.texts) == 2 + 4 + 2


def test_a_part_without_content_has_no_heading():
    text = "".join(Texts(render_page("poses.html.j2", POSES)).texts)
    assert "Each image" in text and "Without a pose" not in text


def test_a_long_table_is_folded():
    rows = tuple((f"{i:02d}", "0.1") for i in range(9))
    long = render_page("poses.html.j2", POSES | {"images": TextTable(("frame", "error"), rows)})
    assert "<details><summary>All images (9)</summary>" in long
    assert "<details>" not in render_page("poses.html.j2", POSES)


def test_a_missing_value_is_an_error():
    with pytest.raises(UndefinedError, match="heading"):
        render_page("poses.html.j2", {name: POSES[name] for name in POSES if name != "heading"})


def test_every_template_compiles():
    environment = _environment()
    assert {"run.html.j2", "doctor.html.j2", "poses.html.j2"} <= set(environment.list_templates())
    for name in environment.list_templates(extensions=["j2"]):
        environment.get_template(name)


def test_the_best_cell_is_marked():
    table = TextTable(("method", "PSNR"), (("a<b", "20"), ("c", "30")), frozenset({(1, 1)}))
    page = render_page("poses.html.j2", POSES | {"images": table})
    assert page.count('class="best"') == 1 and "a&lt;b" in page
    assert '<th scope="row">c</th><td class="best">30</td>' in page


def test_the_slider_can_be_worked_from_the_keyboard():
    page = render_page("poses.html.j2", POSES)
    assert '<input type="range"' in page and "aria-label" in page
    assert not re.search(r"https?://", page)


def test_images_are_shrunk_not_enlarged():
    noise = np.random.default_rng(0).integers(0, 255, (60, 90, 3), np.uint8)
    sizes = [len(data_url(noise, ImageEncoding(px, 80))) for px in (30, 90, 400)]
    assert sizes[0] < sizes[1] == sizes[2]
