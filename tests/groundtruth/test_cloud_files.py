"""Trees of OctoMap hold exactly the cells that were written: for a plain reader, and for OctoMap's
own library.
"""

import struct

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from carlasc.errors import ArgumentError
from carlasc.groundtruth.maps.cloud_files import write_octomap

RES = 0.25


def some_cells(seed=0):
    """Return scattered cells, and a block of eight that is one leaf, around the origin; and which
    are occupied.
    """
    rng = np.random.default_rng(seed)
    block = np.argwhere(np.ones((2, 2, 2))) + (40, -40, 8)
    cells = np.unique(
        np.concatenate([rng.integers(-9, 9, (400, 3)), block, [[-32000, 31000, 5]]]), axis=0
    )
    occupied = rng.random(len(cells)) < 0.6
    occupied[np.isin(cells[:, 0], (40, 41))] = True
    return cells, occupied


def read_tree(path):
    """Return {cell: occupied} of a .bt file, one node after the other, and the number of nodes that
    its header gives.
    """
    header, _, data = path.read_bytes().partition(b"\ndata\n")
    words = dict(
        line.split(" ", 1) for line in header.decode().splitlines() if not line.startswith("#")
    )
    cells, at, nodes = {}, 0, 1

    def visit(corner, depth):
        nonlocal at, nodes
        (bits,) = struct.unpack_from("<H", data, at)
        at += 2
        inner = []
        for child in range(8):
            state, side = bits >> 2 * child & 3, 1 << (15 - depth)
            place = tuple(c + (child >> axis & 1) * side for axis, c in enumerate(corner))
            nodes += state > 0
            if state == 3:
                inner.append(place)
            elif state:
                for index in np.ndindex(side, side, side):
                    cells[tuple(p + i - 32768 for p, i in zip(place, index, strict=True))] = (
                        state == 2
                    )
        for place in inner:
            visit(place, depth + 1)

    visit((0, 0, 0), 0)
    assert at == len(data) and float(words["res"]) == RES and words["id"] == "OcTree"
    return cells, nodes, int(words["size"])


def test_a_plain_reader_finds_every_cell(tmp_path):
    cells, occupied = some_cells()
    write_octomap(tmp_path / "map.bt", cells, occupied, RES)
    found, nodes, said = read_tree(tmp_path / "map.bt")
    assert found == {
        tuple(cell): bool(full) for cell, full in zip(cells.tolist(), occupied, strict=True)
    }
    assert nodes == said


def test_cells_beyond_a_tree_are_refused(tmp_path):
    with pytest.raises(ArgumentError) as error:
        write_octomap(tmp_path / "map.bt", np.array([[32768, 0, 0]]), np.ones(1, bool), RES)
    assert error.value.where == "cell_m" and error.value.found == "8192 m"
    assert not (tmp_path / "map.bt").exists()


@pytest.mark.slow
def test_octomaps_library_reads_our_occupancy(tmp_path):
    pyoctomap = pytest.importorskip("pyoctomap", reason="OctoMap's library is not installed")
    cells, occupied = some_cells()
    write_octomap(tmp_path / "map.bt", cells, occupied, RES)
    tree = pyoctomap.OcTree(RES)
    assert tree.readBinary(str(tmp_path / "map.bt"))
    nodes = [tree.search(((cell + 0.5) * RES).tolist()) for cell in cells]
    assert_array_equal([tree.isNodeOccupied(node) for node in nodes], occupied)
    assert tree.search([0.5 * RES, 0.5 * RES, 100.0]) is None
    assert tree.calcNumNodes() == read_tree(tmp_path / "map.bt")[2]
