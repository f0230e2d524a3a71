"""Array types by what they hold: one name for each, used by every package. Arrays are [y, x], points are (x, y)."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
Float32Array: TypeAlias = NDArray[np.float32]
IntArray: TypeAlias = NDArray[np.int64]
ByteArray: TypeAlias = NDArray[np.uint8]
Mask: TypeAlias = NDArray[np.bool_]
"""True where something holds: of pixels (y, x), or of the rows of a table (n,)."""
GreyImage: TypeAlias = NDArray[np.uint8]
"""(y, x), grey levels."""
RGBImage: TypeAlias = NDArray[np.uint8]
"""(y, x, 3)."""
Points: TypeAlias = NDArray[np.float64]
"""(n, 2) as (x, y), px."""
