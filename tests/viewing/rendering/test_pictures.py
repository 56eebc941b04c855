import numpy as np
import pytest
from helpers.errors import raises
from helpers.readers.pixels import (
    BLUE,
    RED,
    blue_pixels,
    grid_with,
    has_color,
    middle_of,
    red_pixels,
)

from carlasc.core.grids import Grid, GridSpec
from carlasc.core.scans import Scan
from carlasc.core.tables import CARLA, CARLASC11
from carlasc.errors import ArgumentError, FormatError
from carlasc.viewing import (
    Look,
    Panel,
    Viewpoint,
    draw_panels,
    error_drawing,
    flow_drawing,
    grid_drawing,
    render_comparison,
    render_grid,
    render_scan,
    scan_drawing,
)
from carlasc.viewing import colors as palette
from carlasc.viewing.colors import AFTER_CLASSES, ClassColors
from carlasc.viewing.rendering.drawings import ego_vehicle, motion_arrows, scan_extent

pytest.importorskip("PIL")
pytest.importorskip("embreex")

SIZE = (320, 180)
PUBLISHED = [GridSpec.published(name) for name in ("coarse", "fine", "cylindrical")]
views = pytest.mark.parametrize("view", ["perspective", "bev"])


@views
@pytest.mark.parametrize("spec", PUBLISHED, ids=str)
def test_a_block_ahead_on_the_right_is_ahead_and_on_the_right(spec, view):
    grid = grid_with({(10, 5, -0.5): RED, (-10, -15, -0.5): BLUE}, spec)
    picture = render_grid(grid, look=Look(view=view, size=SIZE, legend=False, ego=False))
    red, blue = middle_of(red_pixels(picture)), middle_of(blue_pixels(picture))
    assert red[0] > SIZE[0] / 2 > blue[0]
    assert red[1] < blue[1]
    if view == "bev":  # to scale: 5 m right and 10 m ahead of the middle
        scale = 180 * 0.98 / (60 if spec.coordinates == "cylindrical" else 51.2)
        assert red[0] == pytest.approx(160 + 5 * scale, abs=0.6 * scale)
        assert red[1] == pytest.approx(90 - 10 * scale, abs=0.6 * scale)


@views
def test_in_kittis_frame_left_is_left(view):
    grid = grid_with({(10, 5, -0.5): RED})  # y is left there
    picture = render_grid(
        grid, look=Look(view=view, size=SIZE, legend=False, ego=False, axes="right")
    )
    column, _ = middle_of(red_pixels(picture))
    assert column < SIZE[0] / 2
    mirrored = render_grid(grid, look=Look(view=view, size=SIZE, legend=False, ego=False))[:, ::-1]
    differing = (np.abs(picture.astype(int) - mirrored) > 12).any(-1).mean()
    assert differing < 0.01  # the same picture in a mirror, sun included


def test_a_cylindrical_block_lies_at_its_azimuth():
    spec = PUBLISHED[2]
    labels = np.zeros(spec.size, np.uint32)
    azimuth = np.deg2rad(120)
    column = int((azimuth - spec.lower[1]) / spec.voxel_size[1])
    labels[80:86, column - 1 : column + 2, 3:5] = RED
    picture = render_grid(
        Grid(spec, labels), look=Look(view="bev", size=(200, 200), legend=False, ego=False)
    )
    x, y = middle_of(red_pixels(picture))
    assert np.arctan2(x - 100, 100 - y) == pytest.approx(azimuth, abs=0.05)
    assert np.hypot(x - 100, y - 100) == pytest.approx(83 / 128 * 100 * 0.98, abs=2)


def test_up_is_up_and_near_voxels_hide_far_ones():
    tower = grid_with({(0, 0, 0.3): RED, (0, 0, -1.2): BLUE}, size_m=1.4)
    picture = render_grid(tower, look=Look(size=SIZE, legend=False, ego=False))
    assert middle_of(red_pixels(picture))[1] < middle_of(blue_pixels(picture))[1]
    wall = grid_with({(0, 0, -0.5): RED, (-3, 0, -0.5): BLUE}, size_m=2.4)
    level = Viewpoint(elevation_rad=0.0)
    assert not red_pixels(
        render_grid(wall, look=Look(viewpoint=level, size=SIZE, legend=False, ego=False))
    ).any()
    behind = Viewpoint(azimuth_rad=np.pi, elevation_rad=0.0)
    assert not blue_pixels(
        render_grid(wall, look=Look(viewpoint=behind, size=SIZE, legend=False, ego=False))
    ).any()


def test_free_and_unknown_voxels_are_not_drawn():
    spec = PUBLISHED[0]
    nothing = Grid(spec, np.zeros(spec.size, np.uint8), np.zeros(spec.size, np.float32))
    free = Grid(spec, np.zeros(spec.size, np.uint8), np.ones(spec.size, np.float32))
    np.testing.assert_array_equal(
        render_grid(nothing, look=Look(size=SIZE)), render_grid(free, look=Look(size=SIZE))
    )


def test_the_picture_of_an_empty_grid_says_so():
    spec = PUBLISHED[0]
    empty = Grid(spec, np.zeros(spec.size, np.uint8))
    scene = grid_drawing(empty, ClassColors())
    assert scene.note == "no voxel is occupied"
    picture = render_grid(empty, look=Look(size=SIZE, ego=False))
    silent = draw_panels(
        [Panel(type(scene)(scene.extent, grid_drawing(empty, ClassColors(), ego=False).mesh))],
        size=SIZE,
    )
    assert (silent < 250).any()  # the ground
    assert (silent != picture).any() and picture.min() < 130 < silent.min()  # the words


def test_a_sunlit_top_has_exactly_the_legends_colour():
    grid = grid_with({(0, 0, -0.5): BLUE}, size_m=4.0)
    picture = render_grid(grid, look=Look(view="bev", size=(400, 400), legend=False, ego=False))
    assert has_color(picture[150:250, 150:250], CARLA.colors[BLUE])


@views
def test_the_legend_names_the_classes_present_and_no_other(view):
    grid = grid_with({(0, 0, -0.5): BLUE, (5, 5, -0.5): RED})
    with_legend, without = (
        render_grid(grid, look=Look(view=view, size=(640, 360), legend=shown))
        for shown in (True, False)
    )
    assert with_legend.shape == without.shape == (360, 640, 3)
    strip = with_legend[-40:] if view == "perspective" else with_legend[:, 400:]
    assert has_color(strip, CARLA.colors[BLUE], 0)
    assert has_color(strip, CARLA.colors[RED], 0)
    assert not has_color(strip, CARLA.colors[CARLA.id_of("Road")], 0)


def test_palettes_change_the_colours_and_nothing_else():
    grid = grid_with({(0, 0, -0.5): BLUE}, size_m=4.0)
    pictures = {
        name: render_grid(
            grid, look=Look(view="bev", size=(600, 600), legend=False, ego=False, palette=name)
        )
        for name in ("class", "colorblind", "height")
    }
    assert has_color(pictures["colorblind"], palette.colorblind_palette(CARLA)[BLUE])
    assert not has_color(pictures["height"], CARLA.colors[BLUE])
    drawn = [(picture < 200).any(-1) for picture in pictures.values()]
    assert (drawn[0] == drawn[1]).mean() > 0.99


def test_labels_that_the_table_does_not_know_are_refused():
    grid = grid_with({(0, 0, -0.5): 17})
    with pytest.raises(FormatError, match="found 17"):
        render_grid(grid, CARLASC11, look=Look(size=SIZE))


def scan_of(*clusters):
    """A scan of (center, label, flow, instance) clusters of 200 points."""
    rng = np.random.default_rng(0)
    points, labels, flow, instances = [], [], [], []
    for center, label, velocity, instance in clusters:
        points.append(rng.normal(center, 0.3, (200, 3)))
        labels.append(np.full(200, label))
        flow.append(np.tile(velocity, (200, 1)))
        instances.append(np.full(200, instance))
    return Scan(
        np.concatenate(points).astype(np.float32),
        np.concatenate(labels).astype(np.uint8),
        np.concatenate(flow).astype(np.float32),
        np.concatenate(instances).astype(np.uint32),
    )


EXTENT = np.array([(x, y, z) for x in (-20.0, 20.0) for y in (-20.0, 20.0) for z in (-2.0, 2.0)])


@views
def test_a_scans_points_lie_where_they_are(view):
    scan = scan_of(((10, 5, 0), RED, (0, 0, 0), 0), ((-10, -15, 0), BLUE, (0, 0, 0), 0))
    picture = render_scan(
        scan, look=Look(view=view, size=SIZE, legend=False, ego=False), extent=EXTENT
    )
    red, blue = middle_of(red_pixels(picture)), middle_of(blue_pixels(picture))
    assert red[0] > SIZE[0] / 2 > blue[0]
    assert red[1] < blue[1]


def test_faces_hide_points_behind_them_and_not_those_in_front():
    """The ego vehicle is made of faces: points behind it are hidden, points before it are not."""
    level = Viewpoint(elevation_rad=0.0)
    behind, before = (
        render_scan(
            scan_of(((x, 0, -1.3), RED, (0, 0, 0), 0)),
            look=Look(viewpoint=level, size=SIZE, legend=False),
            extent=EXTENT,
        )
        for x in (6.0, -6.0)
    )
    assert red_pixels(before).sum() > 3 * red_pixels(behind).sum()


def test_points_without_labels_are_drawn_by_height():
    scan = scan_of(((5, 0, -1.8), 0, (0, 0, 0), 0), ((-5, 0, 1.8), 0, (0, 0, 0), 0))
    picture = render_scan(
        Scan(scan.points), look=Look(view="bev", size=SIZE, legend=False, ego=False), extent=EXTENT
    )
    rows, columns = np.nonzero((picture < 200).any(-1))
    ahead = picture[rows[rows < 90], columns[rows < 90]].mean(0)
    astern = picture[rows[rows > 90], columns[rows > 90]].mean(0)
    assert astern.mean() > ahead.mean() + 20  # lower is darker


def test_the_picture_of_a_scan_without_points_says_so():
    scan = Scan(np.empty((0, 3), np.float32), np.empty(0, np.uint8), np.empty((0, 3), np.float32))
    for flow in (False, True):
        assert (render_scan(scan, look=Look(size=SIZE, ego=False), flow=flow) < 200).any()


def test_points_that_are_not_finite_are_left_out():
    scan = scan_of(((10, 5, 0), RED, (0, 0, 0), 0))
    broken = scan.points.copy()
    broken[:5] = np.nan
    picture = render_scan(
        Scan(broken, scan.labels), look=Look(view="bev", size=SIZE, legend=False), extent=EXTENT
    )
    assert red_pixels(picture).any()


def test_each_moving_actor_has_an_arrow_as_long_as_its_movement_in_one_second():
    scan = scan_of(
        ((10, 5, 0), RED, (0, 2, 0), 7),
        ((11, 5, 0), RED, (0, 2, 0), 7),
        ((-10, -15, 0), BLUE, (0, 0, 0), 9),
    )
    tails, vectors = motion_arrows(scan.select(np.linalg.norm(scan.flow, axis=1) > 0.2))
    assert len(tails) == 1
    np.testing.assert_allclose(tails[0, :2], (10.5, 5), atol=0.1)
    assert tails[0, 2] > scan.points[:, 2].max()
    np.testing.assert_allclose(vectors, [[0, 2, 0]], atol=1e-6)
    # instances unknown: by cells of 3 m
    by_place = motion_arrows(Scan(scan.points, scan.labels, scan.flow))
    assert 1 <= len(by_place[0]) <= 4


def test_flow_points_the_right_way_in_the_picture():
    scan = scan_of(((0, 0, 0), BLUE, (8, 8, 0), 1), ((-10, -15, 0), RED, (0, 0, 0), 2))
    picture = render_scan(
        scan,
        look=Look(view="bev", size=(400, 400), legend=False, ego=False),
        flow=True,
        extent=EXTENT,
    )
    dark = (picture < 60).all(-1)
    rows, columns = np.nonzero(dark)
    assert rows.min() < 200 and columns.max() > 200  # ahead and to the right
    assert columns[rows.argmin()] > 200
    assert not red_pixels(picture).any()  # what stands is grey


def test_flow_of_a_scan_without_it_is_refused():
    with pytest.raises(FormatError, match="field flow"):
        render_scan(Scan(np.zeros((3, 3), np.float32)), flow=True)


def test_each_kind_of_error_has_its_colour_where_the_truth_is_known():
    truth = grid_with({(10, 10, -0.5): 10, (10, -10, -0.5): 10, (-10, 10, -0.5): 10}, size_m=4.0)
    prediction = grid_with(
        {(10, 10, -0.5): 10, (10, -10, -0.5): 4, (-10, -10, -0.5): 10, (0, 0, -0.5): 4}, size_m=4.0
    )
    truth.counts[54:74, 54:74] = 0  # the last one of the prediction's is where nobody knows
    right, wrong, missed, invented = (palette.ERRORS.colors[outcome] for outcome in (1, 2, 3, 4))
    quarters = {(1, 1): right, (1, -1): wrong, (-1, 1): missed, (-1, -1): invented}
    scene = error_drawing(prediction, truth, ego=False)
    picture = draw_panels([Panel(scene, "bev")], size=(400, 400), legend=False)
    for (ahead, right), color in quarters.items():
        y, x = 200 - round(ahead * 10 * 392 / 51.2), 200 + round(right * 10 * 392 / 51.2)
        assert has_color(picture[y - 12 : y + 12, x - 12 : x + 12], color), (ahead, right)
    assert picture[190:210, 190:210].min() > 225  # only the ground


def test_a_comparison_is_drawn_side_by_side():
    truth, prediction = (
        grid_with({(0, 0, -0.5): BLUE}, size_m=5.0),
        grid_with({(0, 0, -0.5): RED}, size_m=5.0),
    )
    picture = render_comparison(
        prediction, truth, look=Look(size=(800, 300), ego=False, legend=False), errors=False
    )
    assert middle_of(red_pixels(picture))[0] < 400 < middle_of(blue_pixels(picture))[0]
    with pytest.raises(ArgumentError, match="predicted grid"):
        render_comparison(
            prediction, grid_with({(0, 0, -0.5): RED}, PUBLISHED[1]), look=Look(size=SIZE)
        )


def test_a_picture_is_the_same_every_time():
    grid = grid_with({(10, 5, -0.5): RED})
    np.testing.assert_array_equal(
        render_grid(grid, look=Look(size=SIZE)), render_grid(grid, look=Look(size=SIZE))
    )


def test_edges_of_voxels_are_drawn_only_if_the_voxels_are_large():
    spec = GridSpec.published("cartesian").with_size((8, 8, 1))
    labels = np.zeros(spec.size, np.uint8)
    labels[2:6, 2:6] = CARLA.id_of("Terrain")
    light = CARLA.colors[CARLA.id_of("Terrain")]

    def shades(size):
        picture = render_grid(
            Grid(spec, labels), look=Look(view="bev", size=size, legend=False, ego=False)
        ).astype(int)
        middle = picture[
            int(size[1] * 0.35) : int(size[1] * 0.65), int(size[0] * 0.35) : int(size[0] * 0.65)
        ]
        return np.abs(middle - light).max()

    assert shades((400, 400)) > 20
    tiny = grid_with({}, GridSpec.published("fine"))
    tiny.labels[:, :, 0] = CARLA.id_of("Terrain")
    picture = render_grid(
        tiny, look=Look(view="bev", size=(200, 200), legend=False, ego=False)
    ).astype(int)
    assert np.abs(picture[80:120, 80:120] - light).max() < 12


@pytest.mark.parametrize("view", ["front", ""])
def test_an_unknown_view_is_refused(view):
    with pytest.raises(ArgumentError, match="view"):
        render_grid(grid_with({}), look=Look(view=view, size=SIZE))
    with pytest.raises(ArgumentError, match="panels"):
        draw_panels([])


def test_unknown_axes_are_refused():
    with raises(ArgumentError, where="axes", expected="left, right", found="up"):
        render_grid(grid_with({}), look=Look(axes="up", size=SIZE))


def test_points_have_the_colours_of_their_classes_and_a_legend():
    scan = scan_of(((5, 0, 0), RED, (0, 0, 0), 0), ((0, 5, 0), 0, (0, 0, 0), 0))
    drawing = scan_drawing(scan, ClassColors())
    np.testing.assert_array_equal(
        drawing.point_colors[:200], np.broadcast_to(CARLA.colors[RED], (200, 3))
    )
    np.testing.assert_array_equal(
        drawing.point_colors[200:], np.broadcast_to(palette.UNLABELLED, (200, 3))
    )
    assert [(entry.name, entry.color) for entry in drawing.legend] == [
        ("unlabelled", palette.UNLABELLED),
        ("Pedestrian", CARLA.colors[RED]),
    ]
    labelled = scan_drawing(scan_of(((5, 0, 0), RED, (0, 0, 0), 0)), ClassColors())
    assert [entry.name for entry in labelled.legend] == ["Pedestrian"]


def test_flow_shows_what_moves_faster_than_20_centimetres_a_second():
    scan = scan_of(((5, 0, 0), RED, (0.3, 0, 0), 1), ((0, 5, 0), BLUE, (0, 0.15, 0), 2))
    drawing = flow_drawing(scan, ClassColors())
    np.testing.assert_array_equal(
        drawing.point_colors[:200], np.broadcast_to(CARLA.colors[RED], (200, 3))
    )
    np.testing.assert_array_equal(
        drawing.point_colors[200:], np.broadcast_to(palette.STATIC, (200, 3))
    )
    assert [(entry.color, entry.order) for entry in drawing.legend] == [
        (palette.STATIC, -1),
        (CARLA.colors[RED], RED),
        (palette.ARROW, AFTER_CLASSES),
    ]
    still = flow_drawing(scan_of(((0, 5, 0), BLUE, (0, 0, 0), 2)), ClassColors())
    assert still.note == "nothing moves" and drawing.note is None


def test_points_without_instances_share_an_arrow_within_three_metres():
    points = np.array([[0.5, 0.5, 0], [2.5, 2.5, 1], [3.5, 0.5, 0], [-0.5, 0.5, 0]], np.float32)
    flow = np.tile(np.array([1, 0, 0], np.float32), (4, 1))
    tails, _ = motion_arrows(Scan(points, flow=flow))
    np.testing.assert_allclose(
        sorted(tails.tolist()), [[-0.5, 0.5, 0.4], [1.5, 1.5, 1.4], [3.5, 0.5, 0.4]], atol=1e-6
    )


def test_the_ego_vehicle_is_under_the_sensor_which_is_half_a_metre_behind_its_middle():
    corners = ego_vehicle().corners.reshape(-1, 3)
    np.testing.assert_allclose(corners.min(0), (-1.75, -0.95, -1.62))
    np.testing.assert_allclose(corners.max(0), (2.75, 0.95, -0.42))


def test_a_scan_is_shown_to_at_most_40_metres_and_with_the_surroundings_of_the_sensor():
    far = Scan(np.array([[100, 70, 3], [-100, -70, 3]] * 50, np.float32))
    np.testing.assert_allclose(scan_extent(far)[[0, -1]], [(-40, -40, 0), (40, 40, 3)])
    ahead = Scan(np.tile(np.array([20, 10, 1], np.float32), (100, 1)))
    np.testing.assert_allclose(scan_extent(ahead)[[0, -1]], [(-5, -5, 0), (20, 10, 1)])


def test_the_errors_have_a_legend_after_the_classes_and_say_when_there_is_nothing_to_compare():
    truth, nothing = grid_with({(0, 0, -0.5): BLUE}), grid_with({})
    drawing = error_drawing(truth, truth)
    assert [entry.name for entry in drawing.legend][:2] == ["right class", "wrong class"] and len(
        drawing.legend
    ) == 4
    assert min(entry.order for entry in drawing.legend) > 1000 and drawing.note is None
    assert error_drawing(nothing, nothing).note == "no known voxel is occupied in either"


def test_the_legend_names_the_classes_of_all_panels():
    panels = [
        Panel(grid_drawing(grid_with({(0, 0, -0.5): label}), ClassColors()), "bev")
        for label in (RED, BLUE)
    ]
    legend = draw_panels(panels, size=(640, 360))[-40:]
    assert has_color(legend, CARLA.colors[RED], 0) and has_color(legend, CARLA.colors[BLUE], 0)


@pytest.mark.parametrize("axes", ["left", "right"])
def test_shadows_fall_ahead_to_the_right(axes):
    tower = grid_with({(0, 0, z): BLUE for z in (-1.5, -0.5, 0.5)})
    picture = render_grid(
        tower, look=Look(view="bev", size=(400, 400), legend=False, ego=False, axes=axes)
    )
    right, ahead = (int(400 * 0.98 / 51.2 * metres) for metres in (1.3, 1.0))
    assert picture[200 - ahead, 200 + right].max() < 200  # in the shadow
    for row, column in (
        (200 + ahead, 200 - right),
        (200 + ahead, 200 + right),
        (200 - ahead, 200 - right),
    ):
        assert picture[row, column].min() > 225, (row, column)


def test_walls_hide_a_part_of_the_sky():
    """The wall is ahead on the right, away from the sun: it casts no shadow on what is behind it."""
    ground = {(0, 0, -1.8): CARLA.id_of("Terrain")}
    wall = {(2.4, y, z): BLUE for y in (-2, -1, 0, 1, 2) for z in (-1.5, -0.5, 0.5)}
    lone, beside = (
        render_grid(
            grid_with(blocks, size_m=1.6),
            look=Look(view="bev", size=(400, 400), legend=False, ego=False),
        )
        for blocks in (ground, ground | wall)
    )
    assert has_color(lone[197:204, 197:204], CARLA.colors[CARLA.id_of("Terrain")])
    assert beside[200, 200].sum() < lone[200, 200].sum() - 10


def test_points_behind_others_are_darker():
    x, y = (
        axis.reshape(-1) for axis in np.meshgrid(np.arange(-10, 10, 0.05), np.arange(-10, 10, 0.05))
    )
    scan = Scan(
        np.column_stack([x, y, np.where(y > 0, 1.0, -1.0)]).astype(np.float32),
        np.full(x.size, RED, np.uint8),
    )
    picture = render_scan(
        scan, look=Look(view="bev", size=(400, 400), legend=False, ego=False), extent=EXTENT
    ).astype(float)
    below = picture[150:250, 150:200].mean((0, 2))  # columns from the left towards the edge
    assert below[-2] < 0.9 * below[:40].mean()
