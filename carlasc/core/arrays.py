"""Names of the types of arrays that signatures use most."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
AnyFloatArray = NDArray[np.floating]
IntArray = NDArray[np.int64]
AnyIntArray = NDArray[np.integer]
LabelArray = NDArray[np.unsignedinteger]
BoolArray = NDArray[np.bool_]
