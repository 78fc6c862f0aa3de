"""The page: complete, standing alone, the same for the same data, honest about what is missing."""

import base64
import io
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image
from sample_run import bare, sample

from active3d_pipe.errors import InputError
from active3d_pipe.report.config import ReportSettings
from active3d_pipe.report.data import SECTIONS, Curve, FloorPlan, HeldOutView, Metric, ReportData, Timing
from active3d_pipe.report.page import build_report

SETTINGS = ReportSettings(figure_scale=1.0)
VOID = {"img", "meta", "br", "hr", "link", "input"}
# HTML lets these end tags be left out.
OPTIONAL = {"tr", "th", "td", "p", "li", "dt", "dd", "thead", "tbody"}


class Outline(HTMLParser):
    """Checks nesting; collects section ids, text, images and everything that would be loaded from elsewhere."""

    def __init__(self):
        super().__init__()
        self.stack, self.ids, self.images, self.links, self.text, self.tags = [], [], [], [], [], set()

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.add(tag)
        if tag == "section":
            self.ids.append(attrs["id"])
        if tag == "img":
            self.images.append((attrs["alt"], attrs["src"]))
        self.links += [v for k, v in attrs.items() if k in ("href", "src", "srcset", "data") and v]
        if tag not in VOID:
            self.stack.append(tag)

    def handle_endtag(self, tag):
        while self.stack and self.stack[-1] != tag and self.stack[-1] in OPTIONAL:
            self.stack.pop()
        assert self.stack and self.stack[-1] == tag, f"</{tag}> closes {self.stack[-3:]}"
        self.stack.pop()

    def handle_data(self, data):
        self.text.append(data)


def parse(html: str) -> Outline:
    outline = Outline()
    outline.feed(html)
    outline.close()
    assert outline.stack == []
    return outline


@pytest.fixture(scope="module")
def full():
    return build_report(sample(), SETTINGS)


def test_every_section_is_there_with_its_pictures(full):
    page = parse(full)
    assert page.ids == list(SECTIONS)
    assert "Not shown" not in full
    alts = " ".join(alt for alt, _ in page.images)
    for what in ("floor plan", "Curves", "truth, View 0", "render, View 35", "colour error", "depth error", "Slices",
                 "Fusion", "information gain", "Wall time", "from above, ceiling cut", "from a pose of the run"):
        assert what in alts
    assert len(full) < 6e6


def test_the_page_stands_alone(full):
    page = parse(full)
    assert all(link.startswith(("#", "data:image/")) for link in page.links)
    assert not page.tags & {"script", "link", "iframe", "object"}
    assert "@import" not in full and "url(" not in full
    anchors = {link[1:] for link in page.links if link.startswith("#")}
    assert anchors == set(page.ids)


def test_every_picture_decodes_and_charts_are_not_blank(full):
    for alt, src in parse(full).images:
        kind, data = re.fullmatch(r"data:image/(png|jpeg);base64,([A-Za-z0-9+/=]+)", src).groups()
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            assert image.format.lower() == kind
            assert min(image.size) >= 40 and image.width <= 1200
            assert np.asarray(image.convert("L")).std() > 2, alt


def test_equal_data_give_equal_text():
    def once():
        data = sample(pictures=False)
        return build_report(
            replace(data, views=data.views[:1], curves=data.curves[:1], slices=data.slices[:2], fusion=None,
                    timings=data.timings[:2], decisions=()), SETTINGS
        )
    assert once() == once()


def test_without_data_every_section_says_why():
    html = build_report(bare(), SETTINGS)
    page = parse(html)
    assert page.ids == list(SECTIONS) and page.images == []
    assert html.count("Not shown") == len(SECTIONS)
    assert "Not shown: evaluation.num_views is 0." in html


def test_numbers_reach_the_tables_with_units(full):
    text = " ".join("".join(parse(full).text).split())
    for expected in ("0.62 cm", "96.2 %", "25.31 dB", "15.40 m", "97.2 %", "1 200", "predicted, implicit [bit]"):
        assert expected.replace(" 200", "\u202f200") in text or expected in text
    assert "lpips, lpips_circle, lpips_train: no weights on this machine" in text
    # Only what was measured has a column: no fixed-density form in this run.
    assert "fixed density" not in text


def test_text_is_escaped(full):
    assert "<flat_01>" not in full and "&lt;flat_01&gt; &amp; co" in full
    assert "a &lt; b &amp; c" in full
    html = build_report(ReportData(title="t", config_text="</pre><script>alert(1)</script>"), SETTINGS)
    assert "<script" not in html
    parse(html)


def test_one_of_everything_is_enough():
    """A run that stopped after its first round."""
    data = sample(pictures=False)
    pose = data.trajectory[:1]
    short = replace(
        data, trajectory=pose, keyframes=None, goals=None, views=data.views[:1],
        slices=[replace(s, rounds=s.rounds[:1]) for s in data.slices[:1]],
        curves=[Curve("Mean entropy", "hybrid", "bit", [0], [0.9]), Curve("PSNR", "train", "dB", [0], [None])],
        decisions=data.decisions[:1], timings=[Timing("capture", "capture", 0.0)],
        fusion=replace(data.fusion, rounds=[0], alphas=data.fusion.alphas[:1], evidence=(), noise=()),
        metrics={"steps": Metric(1.0), "psnr": Metric(None, "dB", "", "higher", "no views")},
    )
    page = parse(build_report(short, SETTINGS))
    assert page.ids == list(SECTIONS)


def test_odd_maps_do_not_break_the_figures():
    data = sample(pictures=False)
    nothing_known = replace(data.floor_plan, occupancy=np.full((70, 50), 0.5, np.float32))
    holes = [replace(data.slices[0], rounds=[(0, np.full((70, 50), np.nan, np.float32))])]
    only = ReportData(title="t", floor_plan=nothing_known, slices=holes)
    html = build_report(only, SETTINGS)
    assert html.count("Not shown") == len(SECTIONS) - 2


def test_views_shown_are_limited_and_spread():
    data = replace(bare(), views=sample(pictures=False).views)
    settings = ReportSettings(figure_scale=1.0, max_views=2)
    alts = " ".join(alt for alt, _ in parse(build_report(data, settings)).images)
    assert "View 0" in alts and "View 35" in alts and "View 14" not in alts
    assert "Not shown" in build_report(data, ReportSettings(figure_scale=1.0, max_views=0)).split('id="views"')[1][:200]


def test_wrong_shapes_are_one_line():
    image = np.zeros((4, 4, 3), np.uint8)
    with pytest.raises(InputError, match="same shape"):
        HeldOutView("v", image, image[:2])
    with pytest.raises(InputError, match="floor plan"):
        FloorPlan(np.zeros((3, 3, 3)), np.zeros(2), 0.1, 1.0)
