"""Checks of a data set for known mistakes, with their likely causes; and whether the files of a
grid are unchanged since its report.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from carlasc.core.arrays import Float32Array, LabelArray
from carlasc.core.geometry import check_rigid
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, CarlascError, check_types
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.options import FromScans
from carlasc.groundtruth.reporting import Report, short
from carlasc.inspection.agreement import GridDiagnosis, GridEvidence, GroundBelow, check_actors
from carlasc.inspection.alignment import (
    REACH_M,
    LongOverlap,
    PoseDiagnosis,
    diagnose_poses,
    measure_overlap,
    static_structure,
)
from carlasc.inspection.contents import check_documents, check_frames, check_shapes, check_values
from carlasc.inspection.findings import (
    SEVERITIES,
    Finding,
    SequenceReport,
    Severity,
    ValidationResult,
)
from carlasc.inspection.image_alignment import compare_images, judge_images
from carlasc.inspection.pose_quality import check_poses, check_times, describe_mounting
from carlasc.inspection.soundness import (
    CHECKS,
    OVERLAP,
    ScanFacts,
    judge,
    record_accepted,
    untested,
)
from carlasc.inspection.staleness import check_inputs, check_sample, record_inputs
from carlasc.motion.ground import ground_of
from carlasc.motion.odometry import DRIFT_M
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import as_source, layout
from carlasc.storage.files import AnyPath
from carlasc.storage.folder import FolderSequence
from carlasc.storage.inputs import digest_of
from carlasc.storage.protocol import Sequence, Source
from carlasc.storage.shares import sample_of, source_in

_ADVICE = (
    "make the report again with `carlasc report --remake --save`, or the grid with "
    "`carlasc regrid --overwrite`"
)


def check_reports(sequence: Sequence, frames: Iterable[int]) -> Iterator[Finding]:
    """Compare the files of some frames with the reports beside the grids of a sequence.

    Files that cannot be read are skipped: other checks report them.
    """

    @cache  # reports of several grids name the same fields of scans
    def digest(field: str, frame: int) -> str | None:
        """Return the digest of a field, "" if it does not exist; None if it cannot be read."""
        if frame not in sequence.frames(field):
            return ""
        try:
            return short(digest_of(field, sequence.read(field, frame)))
        except (CarlascError, OSError):
            return None

    for name in sequence.documents():
        grid, _, file = name.rpartition("/")
        if file != layout.REPORT:
            continue
        where = f"{sequence.location}/{name}"
        try:
            report = Report.from_json(sequence.read_document(name), where)
        except CarlascError as error:
            yield replace(Finding.from_error("report", where, error, _ADVICE), severity="warning")
            continue
        where = f"{sequence.location}/{grid}"
        for expected, found in _differences(sequence, grid, report, frames, digest):
            yield Finding("warning", "report", where, expected, found, _ADVICE)
        if missing := set(sequence.frames(f"{grid}/labels").tolist()) - set(report.frames):
            expected = "a report of all frames"
            found = f"{len(missing)} frames that it does not cover"
            yield Finding("note", "report", where, expected, found, _ADVICE)
        yield from check_actors(sequence, grid, report.actors or ())


def _differences(
    sequence: Sequence,
    grid: str,
    report: Report,
    frames: Iterable[int],
    digest: Callable[[str, int], str | None],
) -> Iterator[tuple[str, str]]:
    """Yield what was expected and what was found, for each difference from a report."""
    if report.settings != sequence.params(grid):
        yield "the settings in its report", "another params.json"
    for name, made_from in report.documents.items():
        exists = name in sequence.documents()
        is_same = exists and made_from.matches(sequence.read_document(name))
        if name != layout.params_file(grid) and not is_same:
            found = f"a {name} that changed since" if exists else f"no {name}"
            yield f"the {name} that its report was made from", found
    rows = {frame: row for row, frame in enumerate(report.frames)}
    compared = [frame for frame in frames if frame in rows]
    for field, digests in report.digests.items():
        seen = {frame: digest(field, frame) for frame in compared}
        changed = [
            frame for frame, own in seen.items() if own not in (None, digests.of(rows[frame]) or "")
        ]
        if changed:
            of = f"{len(changed)} of {len(compared)} compared frames"
            found = f"{of} changed since, the first is {changed[0]}"
            yield f"the {field} that its report was made from", found


_SAMPLES = 40  # frames per sequence whose contents are read by default
_POOR_SHARE = 0.5  # a smaller share of points in voxels of their class is an error,
_DOUBTFUL_SHARE = 0.7  # and a smaller one than this a warning
# coarser voxels contain several classes and much free space, so that a small share is no mistake
_COARSE_M = 0.75
_NO_OVERLAP = 0.3  # a smaller overlap of scans under the poses is a warning


def validate(
    source: AnyPath | Source,
    *,
    every: int | None = None,
    sequences: int | None = None,
    accept: Collection[str] = (),
    sample: int = 0,
    record: bool = False,
    run: Run = Run(workers=1),  # noqa: B008 (frozen)
) -> ValidationResult:
    """Check a data set: files against each other, values, poses, times, and scans against poses and
    grids.

    Names, numbers of frames, poses, times and the sizes of local files are checked for all frames;
    contents are read for some frames. A file that cannot be read is a finding; the other files are
    still checked.

    Args:
        source: a path or URL that `carlasc.open` knows, or a Source.
        every: read the contents of every N-th frame; 1 reads all. None: about forty frames per
            sequence.
        sequences: number of sequences to look at, evenly spaced, if there are more. None: all.
        accept: checks whose warnings are true of the place, as in a tunnel: carlasc.json of the
            sequence then says so.
        sample: number of frames of each grid that are made again from the scans beside it and
            compared.
        record: accept grids without a record of what they were made from: write the record of the
            inputs as they are now.
        run: how the work is spread over the sequences, with a callback for progress.

    Returns:
        The findings, and the verdict.

    Raises:
        ArgumentError: `every` or `sequences` is less than 1, no check has the name of an accepted
            one, or the data are not in a folder, so that they cannot say what was accepted or
            recorded.
        MissingDataError: there is no data set.
    """
    check_types(validate, locals())
    if every is not None and every < 1:
        raise ArgumentError("every", expected="1 or more", found=every)
    opened = as_source(source)
    chosen, places = sample_of(opened, sequences, name="sequences")
    some = source_in(opened, chosen).sequences().values()
    plans = [_plan(sequence, every, accept) for sequence in some]
    step = StepCounter(run.progress, sum(plan.steps for plan in plans))
    findings: list[Finding] = []
    reports = []
    if run.is_alone:
        examined: Iterator[_Examined] = (_examine(plan, step) for plan in plans)
    else:
        examined = run_all(_examine, plans, run, lost=_fail)
    for plan, (in_sequence, report) in zip(plans, examined, strict=True):
        more = [*in_sequence, *(record_inputs(plan.sequence) if record else ())]
        more += check_sample(plan.sequence, sample, run) if sample > 0 else ()
        named = [replace(finding, sequence=plan.sequence.path) for finding in more]
        findings += sorted(named, key=lambda finding: SEVERITIES.index(finding.severity))
        reports.append(report)
        if not run.is_alone:
            step(plan.steps)
    if unknown := sorted({*accept} - {*CHECKS} - {finding.check for finding in findings}):
        raise ArgumentError("accept", expected=f"checks, such as {OVERLAP}", found=unknown[0])
    record_accepted(opened, findings, accept)
    return ValidationResult(opened.location, tuple(findings), tuple(reports), places)


@dataclass(frozen=True)
class _CheckedFrames:
    """The frames of a sequence that are checked, by kind of check."""

    sequence: Sequence
    frames: tuple[int, ...]  # the frames of any field
    opened: tuple[int, ...]  # the frames whose files are opened to check their sizes
    read: tuple[int, ...]  # the frames whose contents are read
    accept: Collection[str]  # checks whose warnings are accepted

    @property
    def steps(self) -> int:
        return len(self.opened) + len(self.read) + 1


def _plan(sequence: Sequence, every: int | None, accept: Collection[str]) -> _CheckedFrames:
    numbers = set[int]()
    with suppress(CarlascError):  # which is reported when the sequence is examined
        numbers.update(*(sequence.frames(name).tolist() for name in sequence.fields()))
    frames = tuple(sorted(numbers))
    read = frames[:: every or max(1, len(frames) // _SAMPLES)]
    # opening a local file is cheap; a frame of a packed store must be decoded, and has the right
    # size anyway
    opened = frames if isinstance(sequence, FolderSequence) else read
    return _CheckedFrames(sequence, frames, opened, read, accept)


_Examined = tuple[list[Finding], SequenceReport]


def _fail(plan: _CheckedFrames, message: str) -> _Examined:
    """Return the result of a sequence that no worker could check."""
    finding = Finding("error", "check", plan.sequence.location, "a check that ends", message)
    return [finding], SequenceReport(plan.sequence.path, len(plan.frames), 0, {}, None)


def _examine(plan: _CheckedFrames, step: Callable[[], None] = lambda: None) -> _Examined:
    """Run all checks of a sequence; `step` is called after each of its steps."""
    sequence = plan.sequence
    findings = [*check_documents(sequence)]
    described = _is_described(sequence)
    for check in (check_frames, check_poses, check_times):
        findings.extend(check(sequence))
    for frame in plan.opened:
        findings.extend(check_shapes(sequence, frame, with_grids=described))
        step()
    facts = ScanFacts()
    evidence = dict[str, GridEvidence]()
    below = dict[str, GroundBelow]()
    for frame in plan.read:
        if described:
            findings.extend(check_values(sequence, frame))
            _measure_grids(sequence, frame, facts, evidence, below)
        step()
    made = facts.made(sequence) if described else []
    if described:
        findings.extend(check_reports(sequence, plan.read))
        findings.extend(facts.findings(sequence))
        findings.extend(check_inputs(sequence))
    shares = {}
    for name, grid in evidence.items():
        diagnosis = grid.diagnose()
        if diagnosis.frames:
            shares[name] = diagnosis.share
            findings.extend(_judge_grid(sequence, name, grid.spec, diagnosis))
        findings.extend(below[name].findings(sequence, name))
    poses, overlap = _diagnose_poses(sequence)
    if poses is not None and overlap is not None:
        made.append(OVERLAP)
        findings.extend(_judge_poses(sequence, poses, overlap))
    step()
    images = compare_images(sequence) if described else []
    findings.extend(judge_images(sequence, images))
    quality = None if poses is None else poses.quality
    mounting = None if quality is None else quality.mounting
    findings, checks = judge(sequence, findings, made, plan.accept)
    return findings, SequenceReport(
        sequence.path,
        len(plan.frames),
        len(plan.read),
        shares,
        poses.share if poses is not None and poses.pairs else None,
        None if quality is None else quality.disagreement_m,
        None if quality is None else quality.refined_m,
        {} if mounting is None else mounting.describe(),
        {agreement.camera: str(agreement) for agreement in images},
        checks,
    )


def _is_described(sequence: Sequence) -> bool:
    """Return whether classes and geometry can be read; without them values cannot be checked."""
    try:
        return sequence.metadata is not None and sequence.grids is not None
    except CarlascError:
        return False


def _measure_grids(
    sequence: Sequence,
    frame: int,
    facts: ScanFacts,
    evidence: dict[str, GridEvidence],
    below: dict[str, GroundBelow],
) -> None:
    """Measure the points of a frame, and compare them with its grids.

    Files that cannot be read are skipped: other checks report them.
    """
    points = labels = None
    if "points" in sequence.fields():
        with suppress(CarlascError):
            points, labels = _points(sequence, frame)
            facts.add(points)
    ground = None if points is None else ground_of(points, labels, sequence.metadata.classes.ground)
    for name in sequence.grids:
        # a network makes mistakes, and may have other classes
        if sequence.predicted_by(name) is not None:
            continue
        try:
            grid = sequence.grid(name, frame)
        except CarlascError:
            continue
        facts.occupied.setdefault(name, []).append(bool((grid.labels * grid.known).any()))
        if points is not None and ground is not None:
            evidence.setdefault(name, GridEvidence(grid.spec)).add(points, labels, grid)
            below.setdefault(name, GroundBelow(grid.spec)).add(ground)


def _points(sequence: Sequence, frame: int) -> tuple[Float32Array, LabelArray | None]:
    """Read the points that a grid is made from: finite, and within the ranges given in
    carlasc.json.
    """
    scan = sequence.scan(frame, ("labels",))
    x, y, z = scan.points.T.astype(np.float64)
    distance = np.sqrt(x * x + y * y + z * z)
    keep = np.isfinite(distance) & (distance >= (sequence.metadata.min_range_m or 0.0))
    keep &= distance <= (sequence.metadata.max_range_m or np.inf)
    labels = None if scan.labels is None or not scan.labels.any() else scan.labels[keep]
    return scan.points[keep], labels


def _diagnose_poses(sequence: Sequence) -> tuple[PoseDiagnosis, LongOverlap] | tuple[None, None]:
    """Measure the overlap of scans under their poses; None without several scans or valid poses."""
    if (
        "points" not in sequence.fields()
        or layout.POSES not in sequence.documents()
        or not sequence.metadata.has_rays
        or len(sequence.frames("points")) < 2
    ):
        return None, None
    frames = sequence.frames("points").tolist()
    try:
        poses = check_rigid(np.stack([sequence.read_pose(frame) for frame in frames]), layout.POSES)
    except CarlascError:
        return None, None

    def reading(read: Callable[[int], Any]) -> Callable[[int], Any]:
        def points(index: int) -> Any:
            try:
                return read(frames[index])
            except CarlascError:
                return np.empty((0, 3), np.float32)

        return points

    structure = reading(partial(static_structure, sequence))
    feed = ScanFeed(sequence, FromScans())
    try:
        seconds = np.array([feed.time(frame) for frame in frames])
    except CarlascError:
        seconds = None
    if seconds is not None and not (np.diff(seconds) > 0).all():
        seconds = None  # which is reported elsewhere
    points = reading(feed.static_points)
    found = diagnose_poses(structure, poses, points=points, seconds=seconds)
    return found, measure_overlap(structure, points, poses)


def _judge_grid(
    sequence: Sequence, grid: str, spec: GridSpec, diagnosis: GridDiagnosis
) -> Iterator[Finding]:
    own = diagnosis.share
    corrected = diagnosis.corrected_share
    share = f"{own:.1%} of the points in known voxels, over {diagnosis.frames} frames"
    # The labels are wrong, not the geometry, if occupied voxels agree much better than classes.
    other_classes = diagnosis.occupied_share > max(_DOUBTFUL_SHARE, own + 0.2)
    severity: Severity = "error"
    advice = "draw both with `carlasc render`, or make the grid again with `carlasc regrid`"
    if diagnosis.mistake is not None and not (other_classes and corrected < _POOR_SHARE):
        cause = f"; the likely cause is {diagnosis.mistake}: after correction, {corrected:.1%}"
        advice = (
            "correct the program that writes the points or the grid, or make the grid again with "
            "`carlasc regrid`"
        )
    elif own >= _DOUBTFUL_SHARE or _largest_edge(spec) > _COARSE_M:
        return
    else:
        severity = "error" if own < _POOR_SHARE else "warning"
        cause = (
            ", and no known correction raises it; the likely cause is scans and grids of different "
            "frames"
        )
        if other_classes:
            cause = (
                f", but {diagnosis.occupied_share:.1%} in occupied voxels; the likely cause is "
                "labels of another class table, or in another order"
            )
    where = f"{sequence.location}/{grid}"
    expected = "points in voxels of their class"
    yield Finding(severity, "scan-in-voxels", where, expected, share + cause, advice)


def _largest_edge(spec: GridSpec) -> float:
    """Return the length of the longest edge of a voxel in metres; in a cylindrical grid, at half
    its radius.
    """
    edges = spec.voxel_size.copy()
    if spec.coordinates == "cylindrical":
        edges[1] *= (spec.lower[0] + spec.upper[0]) / 2
    return float(edges.max())


def _judge_poses(
    sequence: Sequence, diagnosis: PoseDiagnosis, overlap: LongOverlap
) -> Iterator[Finding]:
    where = f"{sequence.location}/{layout.POSES}"
    quality = diagnosis.quality
    correction = diagnosis.correction
    mounting = None if quality is None else quality.mounting
    if "kiss-icp" in str(sequence.metadata.extra.get("poses")):
        mounting = None  # poses found from the scans are those of the sensor
    described = None if mounting is None else describe_mounting(mounting)
    check = OVERLAP
    expected = CHECKS[OVERLAP]
    share = f"{diagnosis.share:.1%} of a scan's structure overlaps that of an earlier scan"
    severity: Severity = "warning"
    if correction is not None:
        severity = "error"
        advice = correction.advice
        found = (
            f"{diagnosis.share_there:.1%} of a scan's structure overlaps that of an earlier scan; "
            f"the likely cause is {correction.name}: after correction, "
            f"{diagnosis.corrected_share:.1%}"
        )
    elif diagnosis.offset_m is not None:
        x, y, z = diagnosis.offset_m
        severity = "error"
        found = f"{share}; scans fit best about ({x:.1f}, {y:.1f}, {z:.1f}) m away from their poses"
        advice = "check that the poses belong to this sequence and to these frames"
    elif overlap.is_wrong(diagnosis.share):
        severity = "error"
        found = (
            f"{overlap.share:.1%} of a scan's structure on that of the last scan within "
            f"{REACH_M:g} m of it, and {diagnosis.share:.1%} on nearer scans: a motion is missing"
        )
        advice = "check that the poses belong to this sequence and to these frames"
    elif described is not None:
        found, advice = described
    elif overlap.drift[0] > DRIFT_M:
        found = f"scans that fit {overlap.drift[0]:.2f} m from their poses within ten scans"
        advice = (
            "write refined poses with `carlasc refine`, or estimate them with `carlasc convert "
            "--poses kiss-icp`"
        )
    elif quality is not None and quality.is_poor:
        check = "pose-jitter"
        expected = "scans that agree with their neighbours"
        found = (
            f"scans that are {100 * (quality.disagreement_m or 0):.1f} cm from the surfaces that "
            "their neighbours saw; under refined poses "
            f"{100 * (quality.refined_m or 0):.1f} cm"
        )
        advice = (
            "write refined poses with `carlasc refine` before you stack scans yourself; `carlasc "
            "regrid` refines them anyway"
        )
    elif diagnosis.pairs and diagnosis.share < _NO_OVERLAP:
        found = f"{share}, and no known correction raises it"
        advice = (
            "check that the poses belong to this sequence, or estimate them with `carlasc convert "
            "--poses kiss-icp`"
        )
    else:
        check = found = advice = ""
    if check:
        yield Finding(severity, check, where, expected, found, advice)
    if check != OVERLAP and overlap.why_untested:
        yield untested(OVERLAP, where, overlap.why_untested)
