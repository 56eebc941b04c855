"""JS3C-Net against the reference: names, layouts, every stage, outputs, losses and gradients."""

from __future__ import annotations

import json
import time
from functools import cache

import numpy as np
import pytest

from carlasc import GridSpec
from carlasc.errors import ArgumentError

pytest.importorskip("torch", reason="needs carlasc[torch]")

import torch
from completion.losses import IGNORE
from completion.tasks import WEIGHTINGS
from helpers.errors import raises
from js3cnet.model import JS3CNet, nearest, pool
from js3cnet.sparse import Level, NormReLU, SameSites, Sites
from js3cnet.task import PointsAndVoxels, site_cells

SPECS = {
    "A": GridSpec("cartesian", (32, 32, 8), (-6.4, -6.4, -2.0), (6.4, 6.4, 1.2)),
    "B": GridSpec("cartesian", (32, 32, 8), (0.0, -3.2, -2.0), (6.4, 3.2, -0.4)),
}
SETTINGS = {"A": {}, "B": {"channels": (3,), "residual": True}}
CLASSES = {"A": 11, "B": 20}
SIZES = {"A": (3_147_398, 2_690_410), "B": (4_843_953, 4_334_099)}


@pytest.fixture(scope="module")
def expected(golden):
    with np.load(golden / "js3c.npz") as arrays:
        return dict(arrays)


@cache
def entries(path, tag):
    (listed,) = (
        v for v in json.loads(path.read_text())["configs"][tag].values() if isinstance(v, list)
    )
    return listed


def values(index, entry, keys):
    """Return the golden weights of one entry, in the layout of the file."""
    shape, key = entry["shape"], entry["key"]
    if key.endswith("num_batches_tracked"):
        return np.zeros(shape, np.int64)
    drawn = np.random.default_rng(index).standard_normal(shape)
    if key.endswith("running_var"):
        return (np.abs(drawn) + 0.5).astype(np.float32)
    if (
        key.endswith("weight")
        and len(shape) == 1
        and f"{key.removesuffix('weight')}running_var" in keys
    ):
        return (1 + 0.1 * drawn).astype(np.float32)
    drawn = drawn / np.sqrt(np.prod(shape[1:])) if len(shape) >= 2 else drawn / 10
    return np.asarray(drawn, np.float32)


def layout(array, entry):
    """Return weights in the layout of SparseConvNet, which the network has."""
    if "ref_shape" not in entry:
        return torch.from_numpy(array)
    moved = array.transpose(2, 3, 4, 1, 0) if array.ndim == 5 else array.T
    return torch.from_numpy(moved.reshape(entry["ref_shape"]))


def filled(golden, tag, gain=1.0, **settings):
    listed = entries(golden / "js3c_state_dict.json", tag)
    keys = {entry["key"] for entry in listed}
    network = JS3CNet(
        CLASSES[tag], SPECS[tag], **SETTINGS[tag], **{"search": "topk"} | settings
    ).eval()
    state = {entry["key"]: layout(values(i, entry, keys), entry) for i, entry in enumerate(listed)}
    for entry in listed:
        if len(entry["shape"]) == 5 and entry["key"].startswith("seg_head"):
            state[entry["key"]] = state[entry["key"]] * gain
    network.load_state_dict(state, strict=True)
    return network


def run(network, expected, tag):
    points = torch.from_numpy(expected[f"{tag}_points"])
    cells = torch.from_numpy(expected[f"{tag}_seg_coords"]).long()
    return network([points], [cells])


def close(found, wanted, atol=1e-4):
    np.testing.assert_allclose(found.detach().numpy(), wanted, rtol=0, atol=atol)


@pytest.mark.parametrize("tag", ["A", "B"])
def test_weights_have_the_published_names_layouts_and_number(golden, expected, tag):
    network = filled(golden, tag)
    listed = entries(golden / "js3c_state_dict.json", tag)
    found = {key: list(value.shape) for key, value in network.state_dict().items()}
    assert found == {entry["key"]: entry.get("ref_shape", entry["shape"]) for entry in listed}
    sums = {key: float(value.double().sum()) for key, value in network.state_dict().items()}
    for key, total in zip(expected[f"{tag}_fill_keys"], expected[f"{tag}_fill_sum"], strict=True):
        assert sums[str(key)] == pytest.approx(total, abs=1e-6)
    assert sum(p.numel() for p in network.parameters()) == SIZES[tag][0]
    assert sum(p.numel() for p in network.seg_head.parameters()) == SIZES[tag][1]


@pytest.mark.parametrize("tag", ["A", "B"])
def test_outputs_are_the_golden_ones(golden, expected, tag):
    with torch.no_grad():
        prediction = run(filled(golden, tag), expected, tag)
        close(prediction.points, expected[f"{tag}_seg_logits"])
        close(prediction.voxels.permute(0, 4, 1, 2, 3), expected[f"{tag}_ssc_logits"])


@pytest.mark.parametrize("tag", ["A", "B"])
def test_outputs_with_larger_weights_are_the_golden_ones_at_the_deepest_level_too(
    golden, expected, tag
):
    with torch.no_grad():
        prediction = run(filled(golden, tag, float(expected[f"{tag}_gain_value"])), expected, tag)
        for name, found in {
            "seg": prediction.points,
            "ssc": prediction.voxels.permute(0, 4, 1, 2, 3),
        }.items():
            wanted = expected[f"{tag}_gain_{name}_logits"]
            close(found, wanted, 1e-5 * np.abs(wanted).max())


def test_every_stage_of_the_u_net_is_the_golden_one(golden, expected):
    network, seen = filled(golden, "A"), {}

    def keep(name):
        return lambda _module, _inputs, output: seen.__setitem__(name, output)

    path, u_net = "", network.seg_head.sparseModel[2]
    for level in range(7):
        u_net.get_submodule(f"{path}0").register_forward_hook(keep(f"enc{level}"))
        u_net.get_submodule(path.removesuffix(".")).register_forward_hook(keep(f"dec{level}"))
        if level < 6:
            u_net.get_submodule(f"{path}1.1.1").register_forward_hook(keep(f"down{level}"))
            u_net.get_submodule(f"{path}1.1.4").register_forward_hook(keep(f"up{level}"))
        path += "1.1.2."
    for place, name in enumerate(("vox", "inconv")):
        network.seg_head.sparseModel[place].register_forward_hook(keep(name))
    with torch.no_grad():
        run(network, expected, "A")
    assert len(seen) == 28
    for name, sites in seen.items():
        np.testing.assert_array_equal(
            sites.levels[-1].cells[:, 1:].numpy(), expected[f"A_{name}_coords"], name
        )
        close(sites.features, expected[f"A_{name}_feat"])


def test_pooling_decoder_neighbours_and_fusion_are_the_golden_ones(golden, expected):
    network, seen = filled(golden, "A"), {}
    head = network.complet_head
    modules = {
        name: module for name, module in head.Decoder.named_children() if f"A_{name}" in expected
    }
    modules |= {"decoder": head.Decoder, "fused": head.interaction_module}
    for name, module in modules.items():
        module.register_forward_hook(
            lambda _m, _i, output, name=name: seen.__setitem__(name, output)
        )
    head.register_forward_pre_hook(lambda _m, inputs: seen.__setitem__("volume", inputs[0]))
    with torch.no_grad():
        run(network, expected, "A")
    volume = seen.pop("volume")[0].permute(1, 2, 3, 0)
    cells = volume.any(-1).nonzero()
    np.testing.assert_array_equal(cells, expected["A_pool_coords"])
    close(volume[tuple(cells.T)], expected["A_pool_feat"])
    assert len(seen) == 9
    for name, found in seen.items():
        close(found, expected[f"A_{name}"])


def test_neighbours_are_the_golden_ones_up_to_the_rule_for_index_0(expected):
    supports, queries = (
        torch.from_numpy(expected[f"A_knn_{name}"]) for name in ("support", "query")
    )
    wanted = torch.from_numpy(expected["A_knn_idx"]).long()
    wanted = torch.where(wanted == 0, wanted[:, :1], wanted)
    assert torch.equal(nearest(supports, queries, "topk"), wanted)


def test_the_exact_variant_and_the_reference_s_own_tree_are_the_golden_ones(
    golden, expected, monkeypatch
):
    with torch.no_grad():
        exact = run(filled(golden, "A", exact=True), expected, "A").voxels
        close(exact.permute(0, 4, 1, 2, 3), expected["A_exact_ssc_logits"])
        index = torch.from_numpy(expected["A_nano_knn_idx"]).long()
        monkeypatch.setattr(
            "js3cnet.model.nearest", lambda *_: torch.where(index == 0, index[:, :1], index)
        )
        close(
            run(filled(golden, "A"), expected, "A").voxels.permute(0, 4, 1, 2, 3),
            expected["A_nano_ssc_logits"],
        )


def test_the_tree_and_topk_find_neighbours_at_the_same_distances():
    generator = torch.Generator().manual_seed(0)
    supports = torch.randint(-9, 9, (300, 3), generator=generator).float()
    queries = torch.randint(-9, 9, (80, 3), generator=generator).float()
    found = [
        (supports[nearest(supports, queries, search)] - queries[:, None]).norm(dim=2)
        for search in ("tree", "topk")
    ]
    same = (found[0] == found[1]).all(1)
    # index 0 is taken for empty, in either, and may be found in either of two ties
    assert same.double().mean() > 0.9


def test_fewer_supports_than_neighbours_are_filled_up_with_the_nearest():
    supports, queries = (
        torch.tensor([[9.0, 0, 0], [0, 0, 0], [1, 0, 0]]),
        torch.tensor([[0.0, 0, 0], [2, 0, 0]]),
    )
    for search in ("tree", "topk"):
        assert nearest(supports, queries, search).tolist() == [
            [1, 2, 1, 1, 1, 1, 1, 1],
            [2, 1, 2, 2, 2, 2, 2, 2],
        ]


def test_a_cell_holds_the_mean_of_five_slots():
    features = torch.tensor([[1.0], [10], [100], [7], [1], [1], [1], [1], [1000]])
    cells = torch.tensor([0, 0, 0, 3, 2, 2, 2, 2, 2])
    volume = pool(features, cells, (1, 2, 2, 1)).flatten()
    torch.testing.assert_close(volume, torch.tensor([(3 + 10 + 100) / 5, 0, (4 + 1000) / 5, 7]))
    more = pool(
        torch.cat([features, torch.tensor([[9999.0]])]),
        torch.cat([cells, torch.tensor([2])]),
        (1, 2, 2, 1),
    )
    torch.testing.assert_close(more.flatten(), volume)


def test_a_sparse_convolution_is_the_dense_one_read_at_the_sites():
    torch.manual_seed(0)
    cells = torch.cat([torch.randint(0, 2, (40, 1)), torch.randint(0, 5, (40, 3))], 1)
    level = Level(cells)
    features = torch.randn(len(level.cells), 3)
    layer = SameSites(3, 4)
    dense = torch.zeros(2, 3, 5, 5, 5)
    item, x, y, z = level.cells.unbind(1)
    dense[item, :, x, y, z] = features
    kernel = layer.weight.reshape(3, 3, 3, 3, 4).permute(4, 3, 0, 1, 2)
    wanted = torch.nn.functional.conv3d(dense, kernel, padding=1)[item, :, x, y, z]
    torch.testing.assert_close(layer(Sites(features, (level,))).features, wanted)
    assert torch.equal(level.cells[level.site_of], cells)


def test_the_norm_of_a_single_site_is_finite_in_training():
    norm = NormReLU(3).train()
    sites = Sites(torch.ones(1, 3), (Level(torch.zeros(1, 4, dtype=torch.int64)),))
    assert torch.isfinite(norm(sites).features).all()
    assert torch.isfinite(norm.running_var).all()


def test_items_of_a_batch_do_not_mix(golden, expected):
    network = filled(golden, "A", search="tree")
    points = torch.from_numpy(expected["A_points"])
    cells = torch.from_numpy(expected["A_seg_coords"]).long()
    other, place = points[500:900], cells[500:900]
    with torch.no_grad():
        both = network([other, points], [place, cells])
        alone = network([points], [cells])
    torch.testing.assert_close(both.points[400:], alone.points, rtol=0, atol=1e-5)
    torch.testing.assert_close(both.voxels[1], alone.voxels[0], rtol=0, atol=1e-5)


def test_points_outside_the_grid_are_labelled_and_the_rest_is_completed():
    network = JS3CNet(11, SPECS["A"]).eval()
    points = torch.rand(50, 4) + 100
    cells, within = site_cells(points[:, :3], 0.1, 2048)
    assert within.all() and (cells >= 0).all()
    with torch.no_grad():
        prediction = network([points], [cells])
    assert prediction.points.shape == (50, 10)
    assert torch.isfinite(prediction.voxels).all()


def test_scans_wider_than_the_u_net_lose_the_points_beyond():
    xyz = torch.tensor([[0.0, 0, 0], [1, 0, 0], [7, 0, 0]])
    batch = {"points": [xyz], "point_labels": [torch.tensor([1, 2, 3])]}
    prepared = PointsAndVoxels(extent=64).prepare(batch, torch.device("cpu"))
    assert prepared["points"][0].shape == (2, 4)
    assert prepared["cells"][0].tolist() == [[0, 0, 0], [10, 0, 0]]
    assert prepared["point_labels"][0].tolist() == [1, 2]


def test_augmented_cells_are_within_the_grid_and_come_from_the_generator():
    xyz = torch.rand(500, 3) * 40 - 20
    first, second, again = (
        site_cells(xyz, 0.1, 2048, torch.Generator().manual_seed(seed)) for seed in (0, 1, 0)
    )
    assert first[1].all() and (first[0] >= 0).all() and (first[0] < 2048).all()
    assert torch.equal(first[0], again[0])
    assert not torch.equal(first[0], second[0])
    assert len(torch.unique(first[0], dim=0)) > 450  # neither flattened nor folded


def test_a_cylindrical_grid_is_refused():
    with raises(ArgumentError, where="grid", found="cylindrical"):
        JS3CNet(11, GridSpec.published("cylindrical"))


@pytest.mark.parametrize("tag", ["A", "B"])
def test_losses_and_gradients_are_the_golden_ones(golden, expected, tag):
    network, task = filled(golden, tag), PointsAndVoxels()
    with torch.no_grad():
        network.seg_sigma.fill_(0.5)
        network.complet_sigma.fill_(0.8)
    given = {
        name: torch.from_numpy(expected[f"{tag}_loss_{name}"].astype(np.int64))
        for name in ("seg_label", "ssc_label", "invalid")
    }
    batch = {"point_labels": [torch.where(given["seg_label"] < 0, 0, given["seg_label"] + 1)]}
    target = given["ssc_label"].masked_fill(given["invalid"] == 1, IGNORE)
    outputs = run(network, expected, tag)
    own = [torch.from_numpy(expected[f"{tag}_loss_{name}_w"]) for name in ("seg", "ssc")]
    # Points and voxels have weights of their own there; here those of the points are those of the
    # occupied classes.
    points = task.loss(outputs, batch, target, torch.cat([own[1][:1], own[0]]))
    voxels = task.loss(outputs, batch, target, own[1])
    parts = torch.stack([points[0][0] / points[1][0], voxels[0][1] / voxels[1][1]])
    factors, offset = task.balance(network, parts)
    loss = (factors * parts).sum() + offset
    np.testing.assert_allclose(
        [*parts.tolist(), loss.item()], expected[f"{tag}_loss_values"], rtol=0, atol=1e-4
    )
    loss.backward()
    parameters = dict(network.named_parameters())
    for key, norm in zip(expected[f"{tag}_grad_keys"], expected[f"{tag}_grad_norm"], strict=True):
        gradient = parameters[str(key)].grad
        found = -1.0 if gradient is None else float(gradient.double().norm())
        assert found == pytest.approx(norm, rel=1e-3, abs=1e-5), key


def test_a_scan_without_points_or_with_wrong_ones_is_named():
    task, cpu = PointsAndVoxels(), torch.device("cpu")
    batch = {
        "points": [torch.ones(3, 3), torch.zeros(0, 3)],
        "sequence": ["a", "Town01_Light"],
        "frame": torch.tensor([1, 7]),
    }
    with raises(ArgumentError, where="Town01_Light 7: points", found="none"):
        task.prepare(batch, cpu)
    with raises(ArgumentError, where="points", expected="finite", found="1 points"):
        task.prepare({"points": [torch.tensor([[0.0, 0, 0], [float("nan"), 0, 0]])]}, cpu)


def test_remission_is_the_fourth_column_where_a_network_takes_it_and_must_be_there():
    task, cpu = PointsAndVoxels(remission=True), torch.device("cpu")
    points, remission = torch.rand(5, 3), torch.rand(5)
    (scan,) = task.prepare({"points": [points], "remission": [remission]}, cpu)["points"]
    assert torch.equal(scan, torch.cat([points, remission[:, None]], 1))
    with raises(ArgumentError, expected="remission", found="zeros", advice="js3cnet"):
        task.prepare({"points": [points], "remission": [torch.zeros(5)]}, cpu)
    (plain,) = PointsAndVoxels().prepare({"points": [points]}, cpu)["points"]
    assert torch.equal(plain[:, :3], points) and not plain[:, 3].any()


def test_class_weights_are_cube_roots_of_the_rarity():
    np.testing.assert_allclose(
        WEIGHTINGS[PointsAndVoxels().weighting](np.array([800, 100, 0])), [1, 2, 0]
    )


def test_the_momentum_of_the_norms_of_points_falls_and_the_others_stay():
    network, task = JS3CNet(11, SPECS["A"]), PointsAndVoxels()
    norm = network.seg_head.shape_embedding.bn["bn"]
    found = []
    for epoch in (0, 9, 10, 99):
        task.set_epoch(network, epoch)
        found.append(norm.momentum)
    assert found == [0.5, 0.5, 0.25, 0.01]
    assert network.complet_head.upsample[1].momentum == 0.1


@pytest.mark.slow
def test_a_full_scan_takes_seconds_on_one_core():
    """120,000 points on surfaces, nearly each in a site of its own: at most 2.5 s for the points, 4
    s for all of it.
    """
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-45, 45, (2, 120_000))
    z = np.where(rng.random(120_000) < 0.3, rng.uniform(-1.8, 1, 120_000), -1.8)
    task, network = PointsAndVoxels(), JS3CNet(11, GridSpec.published()).eval()
    scan = {"points": [torch.from_numpy(np.stack([x, y, z], 1).astype(np.float32))]}
    seconds = {}
    with torch.no_grad():
        inputs = task.arguments(task.prepare(scan, torch.device("cpu")))
        for name, call in {"points": network.segment, "all": network}.items():
            times = []
            for _ in range(3):
                start = time.process_time()
                call(*inputs)
                times.append(time.process_time() - start)
            seconds[name] = min(times)
    assert seconds["points"] <= 2.5
    assert seconds["all"] <= 4


def test_points_can_be_labelled_alone(golden, expected):
    network = filled(golden, "A")
    points = [torch.from_numpy(expected["A_points"])]
    with torch.no_grad():
        logits, shape = network.segment(points, [torch.from_numpy(expected["A_seg_coords"]).long()])
    close(logits, expected["A_seg_logits"])
    close(shape, expected["A_shape_feat"])
