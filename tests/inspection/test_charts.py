import re
import zlib

import numpy as np
import pytest

from carlasc.core.tables import CARLA
from carlasc.inspection.charts import draw_histograms
from carlasc.inspection.statistics import Histogram, Statistics

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def statistics():
    counts = np.zeros(CARLA.num_channels, np.int64)
    counts[[1, 4, 7, 10]] = 900, 5, 4000, 60
    histogram = Histogram(counts, counts)
    return Statistics("town", CARLA, None, {"Train/Town01": histogram}, {"Train/Town01": "Train"})


def objects_of(pdf):
    """Return the objects of a PDF by number: the bytes between `obj` and `endobj`."""
    return {
        int(number): body
        for number, body in re.findall(rb"(\d+) 0 obj\s(.*?)endobj", pdf, re.DOTALL)
    }


def test_a_pdf_contains_its_fonts_as_truetype(statistics, tmp_path):
    draw_histograms(statistics, tmp_path / "a.pdf")
    objects = objects_of((tmp_path / "a.pdf").read_bytes())
    fonts = [body for body in objects.values() if re.search(rb"/Type /Font\b(?!Desc)", body)]
    kinds = {re.search(rb"/Subtype /(\w+)", body)[1] for body in fonts}
    # Type 3 is what publishers refuse
    assert fonts and kinds <= {
        b"Type0",
        b"CIDFontType2",
        b"TrueType",
    }
    descriptors = [body for body in objects.values() if b"/Type /FontDescriptor" in body]
    assert descriptors
    for descriptor in descriptors:
        file = objects[int(re.search(rb"/FontFile2 (\d+) 0 R", descriptor)[1])]
        data = re.search(rb"stream\r?\n(.*?)\r?\nendstream", file, re.DOTALL)[1]
        # the first bytes of a TrueType font
        assert zlib.decompress(data).startswith(b"\x00\x01\x00\x00")


def test_the_letters_of_an_svg_are_outlines(statistics, tmp_path):
    draw_histograms(statistics, tmp_path / "a.svg")
    svg = (tmp_path / "a.svg").read_text()
    assert "<text" not in svg and "font-family" not in svg
    assert "DejaVuSans" in svg  # glyphs, named after the font that they come from
