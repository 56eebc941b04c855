"""What the first use compiles: formatting the messages of NumPy's errors takes longer than our loops."""

import os
import subprocess
import sys

PROGRAM = """
import numpy as np
from numba.core import event

class Compiled(event.Listener):
    def on_start(self, found):
        print(found.data["dispatcher"].py_func.__module__, found.data["dispatcher"].py_func.__name__)
    def on_end(self, found):
        pass

event.register("numba:compile", Compiled())

from carlasc.metrics.counting import count_arrays
from carlasc.viewing.rendering.cameras import Camera
from carlasc.viewing.rendering.meshes import box
from carlasc.viewing.rendering.rasterizing import hits, visible_triangles

labels = np.zeros(9, np.uint8)
count_arrays(labels, labels, None, 3)
mesh, camera = box((-1, -1, 2), (1, 1, 3), (1, 2, 3)), Camera(np.zeros(3), np.eye(3), 1.0)
seen = visible_triangles(mesh, camera, 8, 8)
hits(mesh.corners, seen.reshape(-1), *camera.rays(8, 8, slice(0, 8)))
"""


def test_loops_compile_without_the_messages_of_numpy(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    compiled = [line.split() for line in ran.stdout.splitlines()]
    assert {"_count_pairs", "_fill", "hits", "_rays"} <= {name for _, name in compiled}
    assert not [name for module, name in compiled if "unicode" in module]
