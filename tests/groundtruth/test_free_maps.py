"""Maps of free space against a plain count of the samples of rays."""

import numpy as np
import pytest

from carlasc.core.geometry import rotation_z, transform_points, translation
from carlasc.core.grids import GridSpec
from carlasc.groundtruth.from_scans.free_space import FreeMap
from carlasc.groundtruth.from_scans.merging import Cast

SPEC = GridSpec("cartesian", (20, 20, 8), (-4.0, -4.0, -1.6), (4.0, 4.0, 1.6))
STEP_M = 0.7
ROOM = np.full(3, 60.0)


def cast(seed, count=400, places=1, room=ROOM):
    """Return rays from some places near the origin."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-9, 9, (count, 3)).astype(np.float32)
    poses = np.stack([translation(rng.uniform(-1, 1, 3)) @ rotation_z(k) for k in range(places)])
    ends = np.sort(rng.integers(0, count, places))
    ends[-1] = count
    return Cast(points, ends, poses, -room, room)


def samples(rays):
    """Return the samples of rays, frame of the map."""
    found = [np.empty((0, 3))]
    for pose, a, b in zip(rays.map_T_places, [0, *rays.ends[:-1]], rays.ends, strict=True):
        for point in rays.points[a:b].astype(np.float64):
            norm = np.linalg.norm(point)
            steps = np.arange(1, int(np.ceil(norm / STEP_M)))[:, None]
            found.append(transform_points(pose, point - steps * STEP_M * point / norm))
    return np.concatenate(found)


def plain(casts, spec=SPEC):
    voxels = spec.flat_index(np.concatenate([samples(rays) for rays in casts]))
    return np.bincount(voxels[voxels >= 0], minlength=spec.num_voxels)


def held(casts, scans=None, **options):
    found = FreeMap(SPEC, STEP_M, **options)
    found.hold(range(len(casts)) if scans is None else scans, casts.__getitem__)
    return found


@pytest.mark.parametrize("places", [1, 3])
@pytest.mark.parametrize("fine", [False, True])
def test_voxels_that_lie_on_the_cells_have_all_samples_in_them(places, fine):
    casts = [cast(seed, places=places) for seed in range(3)]
    found = held(casts, fine=fine).count(np.eye(4))
    assert np.count_nonzero(found != plain(casts)) <= 2  # at an edge, by rounding
    assert found.sum() > 1000


def test_a_mirrored_grid_has_the_samples_of_the_other_side():
    found, mirror = held([cast(0)]), np.diag([1.0, -1.0, 1.0, 1.0])
    sides = found.count(np.eye(4)).reshape(SPEC.size)
    assert np.array_equal(found.count(mirror).reshape(SPEC.size), sides[:, ::-1])


def test_a_turned_grid_has_about_as_many_samples():
    found = held([cast(seed, 4000) for seed in range(4)])
    pose = translation((0.3, -0.2, 0.1)) @ rotation_z(0.5)
    centers = SPEC.centers().reshape(-1, 3)
    turned, level = (
        float(found.count(one)[np.linalg.norm(transform_points(one, centers), axis=1) < 3].sum())
        for one in (pose, np.eye(4))
    )
    assert turned == pytest.approx(level, rel=0.02)


@pytest.mark.parametrize("counted", ["samples", "scans", "last"])
def test_what_was_held_before_leaves_nothing(counted):
    casts = [cast(seed) for seed in range(8)]
    found = FreeMap(SPEC, STEP_M, counted)
    for scans in ([0, 1, 2, 3, 4], [7, 6, 1, 2, 3, 4], [5, 2, 3, 4], [1, 2, 3, 4, 5], [4, 5, 6]):
        found.hold(scans, casts.__getitem__)
        counts = [
            one.count(np.eye(4)) for one in (found, held(casts, scans[::-1], counted=counted))
        ]
        if counted == "last":  # only whether there are any
            counts = [held(casts, scans).count(np.eye(4)) > 0, *(one > 0 for one in counts)]
        assert all(np.array_equal(counts[0], one) for one in counts)
    found.hold([], casts.__getitem__)
    assert not found.count(np.eye(4)).any()


def test_a_scan_that_cannot_be_read_leaves_the_map_as_it_was():
    casts = [cast(seed) for seed in range(4)]

    def read(scan):
        if scan == 3:
            raise OSError(scan)
        return casts[scan]

    found = held(casts, [0, 1])
    with pytest.raises(OSError, match="3"):
        found.hold([1, 2, 3], read)
    found.hold([0, 2], read)
    assert np.array_equal(found.count(np.eye(4)), held(casts, [0, 2]).count(np.eye(4)))


def test_views_count_scans_and_not_samples():
    casts = [cast(seed, 4000) for seed in range(3)]
    views = held([*casts, casts[0]], counted="scans").count(np.eye(4))
    seen = [plain([rays]) > 0 for rays in casts]
    expected = seen[0] * 2 + seen[1] + seen[2]
    assert np.count_nonzero(views != expected) <= 2


def test_a_region_does_not_change_what_is_in_it():
    rays = [cast(seed, 2000) for seed in range(2)]
    small = [one._replace(lower=np.full(3, -1.0), upper=np.full(3, 1.0)) for one in rays]
    inside = (np.abs(SPEC.centers().reshape(-1, 3)) < 1).all(axis=1)
    whole, part = held(rays).count(np.eye(4)), held(small).count(np.eye(4))
    assert np.array_equal(whole[inside], part[inside]) and whole[inside].all()


def test_scans_that_reach_no_grid_and_scans_without_points_leave_the_others():
    rays = cast(0)
    away = rays._replace(lower=np.full(3, 40.0), upper=np.full(3, -40.0))
    empty = cast(1)._replace(points=np.empty((0, 3), np.float32), ends=np.array([0]))
    casts = [away, rays, empty, away]
    found = held(casts)
    assert np.array_equal(found.count(np.eye(4)), held([rays]).count(np.eye(4)))
    found.hold([0, 2, 3], casts.__getitem__)
    assert not found.count(np.eye(4)).any()


def test_memory_that_runs_out_leaves_no_half_scan(monkeypatch):
    casts = [cast(0), cast(1, 4000)]
    found = held(casts, [0])

    def full(self):
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(FreeMap, "_grow", full)
        with pytest.raises(MemoryError):
            found.hold([0, 1], casts.__getitem__)
    found.hold([0], casts.__getitem__)
    assert np.array_equal(found.count(np.eye(4)), held(casts, [0]).count(np.eye(4)))


def test_memory_does_not_grow_along_a_drive():
    found, sizes = FreeMap(SPEC, STEP_M), []

    def along(frame):
        place = np.array([3.0 * frame, 2.0 * frame, 0.0])
        rays = cast(frame)
        return rays._replace(
            map_T_places=translation(place) @ rays.map_T_places, lower=place - 9, upper=place + 9
        )

    for frame in range(120):
        found.hold(range(max(frame - 5, 0), frame + 1), along)
        sizes.append(len(found._blocks.counts))
    assert sizes[-1] == sizes[40] and found.count(translation((357.0, 238.0, 0))).any()
    found.hold([], along)
    assert not found._blocks.counts.any()


@pytest.mark.parametrize("fine", [False, True])
def test_a_cylindrical_grid_has_no_gaps_near_its_axis(fine):
    spec = GridSpec("cylindrical", (20, 90, 8), (0.0, -np.pi, -1.6), (8.0, np.pi, 1.6))
    found = FreeMap(spec, STEP_M, fine=fine)
    rays = cast(0, 60_000)
    found.hold([0], lambda scan: rays)
    counts = found.count(np.eye(4)).reshape(spec.size)
    expected = plain([rays], spec).reshape(spec.size)
    assert counts.sum() == pytest.approx(expected.sum(), rel=0.1)
    ring = slice(3, 15)
    assert (counts[ring] > 0).mean() > 0.99
    alike = np.corrcoef(counts[ring].ravel(), expected[ring].ravel())[0, 1]
    assert alike > (0.9 if fine else 0.8)  # small cells are more exact
