from .clusters import open_cluster as open_cluster
from .engines import Engine as Engine
from .options import Run as Run
from .options import count_cores as count_cores
from .parts import Part as Part
from .processes import run_all as run_all
