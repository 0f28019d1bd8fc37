"""Array types of the mechanics: plain float64 arrays in, plain float64 arrays out."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
AnyArray: TypeAlias = NDArray[Any]
Vector: TypeAlias = tuple[float, float, float]
