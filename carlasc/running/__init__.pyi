from .clusters import open_cluster as open_cluster
from .processes import run_all as run_all
from .spreading import Engine as Engine
from .spreading import Part as Part
from .spreading import Run as Run
from .spreading import count_cores as count_cores
