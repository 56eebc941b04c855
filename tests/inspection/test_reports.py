"""Reports that are read, made from files, compared with files, and drawn."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from helpers.scenes import passing_car

import carlasc
from carlasc import GridSpec, Run
from carlasc.errors import ArgumentError, ConflictError, FormatError, MissingDataError
from carlasc.groundtruth import FromScans, regrid
from carlasc.inspection import report, validate, write_report_page
from carlasc.inspection.report_page import describe
from carlasc.inspection.reports import ReportResult
from carlasc.inspection.validation import check_reports
from carlasc.storage import FolderSink, layout

FRAMES = 7
SPEC = GridSpec.published().with_resolution(0.8)
GRID = layout.grid_folder(SPEC)
NAME = f"cartesian/{GRID}"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = passing_car.write_sequence(tmp_path_factory.mktemp("street"), frames=FRAMES)
    regrid(folder, SPEC, observe=FromScans(window=(-2, 2)), run=Run(workers=1))
    return folder


@pytest.fixture
def copied(made, tmp_path):
    return shutil.copytree(made, tmp_path / "Street")


def test_the_report_of_a_run_is_read(made, monkeypatch):
    monkeypatch.delattr("carlasc.storage.published.PublishedSequence.read")  # no frame is read
    result = report(made)
    assert result.failures == ()
    assert result.reports[NAME].frames == tuple(range(FRAMES))
    assert json.loads(json.dumps(result.to_dict()))["reports"][NAME]["grid"] == GRID


def test_a_report_that_is_made_from_files_is_that_of_the_run(made, copied):
    steps = []
    again = report(made, remake=True, run=Run(workers=1, progress=lambda *step: steps.append(step)))
    assert again == report(made)
    # poses, actors, and the frames
    assert steps == [(i, 3 * FRAMES) for i in range(3 * FRAMES + 1)]
    next(copied.rglob(layout.REPORT)).unlink()
    with ThreadPoolExecutor(2) as threads:
        assert report(copied, run=Run(executor=threads, workers=2)).reports == again.reports
    assert not list(copied.rglob(layout.REPORT))


def test_reports_are_saved_on_request(copied):
    before = next(copied.rglob(layout.REPORT)).read_bytes()
    next(copied.rglob(layout.REPORT)).unlink()
    report(copied, save=True, run=Run(workers=1))
    assert next(copied.rglob(layout.REPORT)).read_bytes() == before


def test_held_out_scores_are_added_and_kept(copied):
    result = report(copied, holdout=True, save=True, run=Run(workers=1))
    rays = result.reports[NAME].holdout["rays"]
    assert rays["returns"] > 1000
    assert rays["occupied"] > 0.9
    assert report(copied).reports == result.reports


def test_published_grids_have_reports_that_are_never_saved(golden_capture, tmp_path):
    folder = shutil.copytree(golden_capture / "cartesian", tmp_path / "cartesian")
    result = report(folder, run=Run(workers=1))
    made = result.reports["evaluation"]
    assert made.coverage.known > 0
    assert (made.actors, made.convergence) == (None, None)
    assert report(folder, holdout=True, run=Run(workers=1)).reports["evaluation"].holdout is None
    with pytest.raises(ConflictError) as caught:
        report(folder, save=True)
    assert caught.value.expected == "a grid that carlasc made"
    assert not list(folder.rglob(layout.REPORT))


def test_a_store_keeps_the_report_and_takes_none(made, tmp_path):
    pytest.importorskip("h5py")
    carlasc.pack(made, tmp_path / "a.h5")
    packed = report(tmp_path / "a.h5").reports
    assert list(packed.values()) == list(report(made).reports.values())
    assert list(
        report(tmp_path / "a.h5", remake=True, run=Run(workers=1)).reports.values()
    ) == list(packed.values())
    found = validate(tmp_path / "a.h5").findings
    assert {one.check for one in found if one.severity == "warning"} <= {"poses-on-scans"}
    with pytest.raises(ArgumentError) as caught:
        report(tmp_path / "a.h5", save=True)
    assert caught.value.where == "save"


def test_a_frame_that_cannot_be_read_is_a_failure_and_the_others_are_reported(copied):
    next(copied.rglob(f"{GRID}/000002.label")).write_bytes(b"odd")
    result = report(copied, remake=True, run=Run(workers=1))
    (failure,) = result.failures
    assert failure.frame == 2
    assert result.reports[NAME].frames == tuple(frame for frame in range(FRAMES) if frame != 2)


def test_a_damaged_report_is_an_error_that_remaking_avoids(copied):
    next(copied.rglob(layout.REPORT)).write_text("{}")
    with pytest.raises(FormatError) as caught:
        report(copied)
    assert caught.value.where.endswith(layout.REPORT)
    assert report(copied, remake=True, run=Run(workers=1)).reports[NAME].frames


def test_a_grid_that_does_not_exist_is_missing(made):
    with pytest.raises(MissingDataError) as caught:
        report(made, grid="other")
    assert caught.value.expected == "the grid other"
    assert set(report(made, grid=GRID).reports) == {NAME}


def changes(folder, *, every=1):
    return [
        (finding.severity, finding.found)
        for finding in validate(folder, every=every).findings
        if finding.check == "report"
    ]


def test_files_that_have_not_changed_agree_with_their_report(made):
    assert changes(made) == []


def test_a_changed_grid_a_changed_scan_and_changed_poses_are_found(copied):
    folder = copied / "cartesian"
    writer = FolderSink(copied).sequence("cartesian")
    labels = writer.read(f"{GRID}/labels", 3).copy()
    labels[5] = 1
    writer.write(f"{GRID}/labels", 3, labels)
    for frame in (1, 2):
        points = writer.read("points", frame).copy()
        points[0, 0] += 0.5
        writer.write("points", frame, points)
    text = (folder / layout.POSES).read_bytes()
    (folder / layout.POSES).write_bytes(b"2.0" + text[3:])
    found = [text for severity, text in changes(copied) if severity == "warning"]
    assert f"1 of {FRAMES} compared frames changed since, the first is 3" in found
    assert f"2 of {FRAMES} compared frames changed since, the first is 1" in found
    assert any("poses.txt that changed since" in text for text in found)
    assert len(found) == 3


def test_other_settings_and_a_field_that_vanished_are_found(copied):
    params = copied / "cartesian" / layout.params_file(GRID)
    values = json.loads(params.read_text())
    values["carlasc"]["window"] = "-9:9"
    params.write_text(json.dumps(values))
    (copied / "cartesian" / layout.TIMES).unlink()
    (copied / "cartesian" / "predictions" / "000004.bin").unlink()
    found = [text for _, text in changes(copied)]
    assert found == [
        "another params.json",
        "no times.txt",
        f"1 of {FRAMES} compared frames changed since, the first is 4",
    ]


def test_more_poses_are_no_change_and_more_frames_are_a_note(copied):
    writer = FolderSink(copied).sequence("cartesian")
    for part in ("labels", "counts"):
        writer.write(f"{GRID}/{part}", FRAMES, np.ones(SPEC.num_voxels, np.uint32))
    for name in (layout.POSES, layout.TIMES):
        data = writer.read_document(name)
        writer.write_document(name, data + data.splitlines(keepends=True)[-1])
    assert changes(copied) == [("note", "1 frames that it does not cover")]


def test_a_damaged_report_is_a_warning_of_validate(copied):
    next(copied.rglob(layout.REPORT)).write_text("no json")
    ((severity, _),) = changes(copied)
    assert severity == "warning"


@pytest.mark.parametrize(
    ("confidences", "severity", "said"),
    [
        ([1.0], None, ""),
        ([0.9, 0.7, 0.95, 1.0], "note", "3 actors"),
        ([0.6] * 3 + [0.9], "warning", "3 of them doubtful"),
    ],
)
def test_actors_that_free_space_shows_are_counted_and_many_doubtful_ones_are_a_warning(
    copied, confidences, severity, said
):
    path = next(copied.rglob(layout.REPORT))
    values = json.loads(path.read_text())
    (actor,) = values["actors"]
    values["actors"] = [actor | {"confidence": confidence} for confidence in confidences]
    path.write_text(json.dumps(values))
    found = [finding for finding in validate(copied, every=1).findings if finding.check == "actors"]
    assert [finding.severity for finding in found] == ([severity] if severity else [])
    assert all(said in finding.found for finding in found)
    doubtful = sum(confidence < 0.8 for confidence in confidences)
    rows = dict(describe(report(copied).reports[NAME]))
    assert (f"{doubtful} of them doubtful" in rows["actors"]) == (doubtful > 0)


def test_a_frame_of_no_report_is_not_compared(made):
    (sequence,) = carlasc.open(made).sequences().values()
    assert list(check_reports(sequence, [1000])) == []


class Checked(HTMLParser):
    """Collects the tags that are open, the text, and every attribute."""

    def __init__(self):
        super().__init__()
        self.open, self.seen, self.attributes = [], [], []

    def handle_starttag(self, tag, attrs):
        self.attributes += attrs
        if tag not in ("meta", "rect"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag != "rect":
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.seen.append(data)


def test_the_page_loads_nothing_and_shows_every_figure(made, tmp_path):
    result = report(made, holdout=True, run=Run(workers=1))
    write_report_page(result, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    parser = Checked()
    parser.feed(text)
    assert parser.open == []
    assert "http" not in text.replace("http-equiv", "")
    assert not {name for name, _ in parser.attributes} & {"src", "href", "onload"}
    assert {NAME, "Vehicle", "10-20 m", "2 to 3"} <= set(parser.seen)
    assert "window -2:2" in text
    assert result.reports[NAME].digests[f"{GRID}/labels"].all in text


def test_names_are_escaped_on_the_page(made, tmp_path):
    one = report(made).reports[NAME]
    odd = replace(
        one, settings={**one.settings, "carlasc": {"observe": "<script>alert(1)</script>"}}
    )
    write_report_page(ReportResult("<b>here", {"<i>a": odd}), tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert "<script" not in text
    assert "<b>" not in text
    assert "&lt;i&gt;a" in text


def test_a_report_without_actors_votes_and_scores_is_drawn(made, tmp_path):
    one = report(made).reports[NAME]
    bare = replace(
        one,
        actors=None,
        convergence=None,
        coverage=replace(one.coverage, votes=(), mean_votes=None),
        frames=(),
    )
    for number, shown in enumerate((bare, replace(bare, actors=()))):
        write_report_page(ReportResult("here", {"a": shown}), tmp_path / f"{number}.html")
        parser = Checked()
        parser.feed((tmp_path / f"{number}.html").read_text())
        assert parser.open == []
