from .carla.recording import RecordResult as RecordResult
from .carla.recording import record as record
from .carla.server import ServerError as ServerError
from .town.actors import TownActor as TownActor
from .town.drive import TownDrive as TownDrive
from .town.simulation import SimulatedCapture as SimulatedCapture
