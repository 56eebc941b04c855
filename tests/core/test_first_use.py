"""What the first use compiles: formatting the messages of NumPy's errors takes longer than our
loops.
"""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import numpy as np
from numba.core import event

class Compiled(event.Listener):
    def on_start(self, found):
        print(found.data["dispatcher"].py_func.__module__, found.data["dispatcher"].py_func.__name__)
    def on_end(self, found):
        pass

event.register("numba:compile", Compiled())

from carlasc.metrics.confusion import count_arrays
from carlasc.viewing.rendering.cameras import Camera
from carlasc.viewing.rendering.meshes import box
from carlasc.viewing.rendering.rasterizing import hits, visible_triangles

labels = np.zeros(9, np.uint8)
count_arrays(labels, labels, None, 3)
mesh, camera = box((-1, -1, 2), (1, 1, 3), (1, 2, 3)), Camera(np.zeros(3), np.eye(3), 1.0)
seen = visible_triangles(mesh, camera, 8, 8)
hits(mesh.corners, seen.reshape(-1), *camera.rays(8, 8, slice(0, 8)))
"""


@pytest.mark.slow
def test_loops_compile_without_the_messages_of_numpy(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    compiled = [line.split() for line in ran.stdout.splitlines()]
    assert {"_count_pairs", "_fill", "_write_hits", "_write_rays"} <= {name for _, name in compiled}
    assert not [name for module, name in compiled if "unicode" in module]


NOTED = """
import sys
from carlasc.core.first_use import note_compiling
note_compiling(lambda: print("told"), after_s=float(sys.argv[1]))
assert "numba" not in sys.modules
import numpy as np
from carlasc.metrics.confusion import count_arrays
labels = np.zeros(9, np.uint8)
count_arrays(labels, labels, None, 3)
"""


def told(cache, after_s):
    """Return how often a process that counts pairs of labels is told that it compiles."""
    ran = subprocess.run(
        [sys.executable, "-c", NOTED, str(after_s)],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return ran.stdout.split().count("told")


@pytest.mark.slow
def test_a_note_is_given_once_where_compiling_takes_long_and_never_where_it_was_done_before(
    tmp_path,
):
    assert told(tmp_path / "long", 0.01) == 1
    assert told(tmp_path / "long", 0.01) == 0
    assert told(tmp_path / "short", 60) == 0


WORKERS = """
import sys
from carlasc.core import first_use
from carlasc.running.pools import OwnProcesses

def work(number):
    from carlasc.metrics.confusion import ConfusionMatrix
    import numpy as np
    return ConfusionMatrix(3).update(np.ones(9, int), np.ones(9, int), np.ones(9, bool)).total

if __name__ == "__main__":
    first_use.note_compiling(first_use.say_compiling, after_s=1.0)
    with OwnProcesses(2) as pool:
        print([pool.submit(work, n).result() for n in range(4)])
"""


@pytest.mark.slow
def test_of_several_workers_that_compile_one_says_so(tmp_path):
    (tmp_path / "script.py").write_text(WORKERS.replace("after_s=1.0", "after_s=0.01"))
    said = []
    for _ in range(2):
        ran = subprocess.run(
            [sys.executable, str(tmp_path / "script.py")],
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")},
            capture_output=True,
            text=True,
            check=True,
            timeout=120,
        )
        assert ran.stdout == "[9, 9, 9, 9]\n"
        said.append(ran.stderr.count("compiling (once per machine)"))
    assert said == [1, 0]


FIRST = """
import os
import carlasc.metrics.confusion as confusion
from carlasc.running import Run, run_all

def work(number):
    import numpy as np
    nine = np.ones(9, int)
    confusion.ConfusionMatrix(3).update(nine, nine, nine > 0)
    return os.getpid(), sum(confusion._count_pairs.stats.cache_misses.values())

if __name__ == "__main__":
    print(len({process for process, misses in run_all(work, range(8), Run(workers=4)) if misses}))
"""


@pytest.mark.slow
def test_one_worker_compiles_before_the_others_start(tmp_path):
    (tmp_path / "script.py").write_text(FIRST)
    compiled = [  # number of processes that compiled, in two runs
        subprocess.run(
            [sys.executable, str(tmp_path / "script.py")],
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")},
            capture_output=True,
            text=True,
            check=True,
            timeout=120,
        ).stdout
        for _ in range(2)
    ]
    assert compiled == ["1\n", "0\n"]
