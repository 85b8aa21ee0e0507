# SPDX-License-Identifier: Apache-2.0
"""The points of a mixture, placed in the frame that the node publishes in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from garps_core.checks import Float64Array
from garps_core.types import Mixture


@dataclass(frozen=True, eq=False)
class ColouredPoints:
    """Points (Nx3 float32, m) with colours (Nx3 uint8, RGB)."""

    points: npt.NDArray[np.float32]
    colours: npt.NDArray[np.uint8]


def coloured_points(mixture: Mixture, T: Float64Array) -> ColouredPoints:
    """Return the means of a mixture after the transform T (4x4, m), with their colours."""
    points = mixture.means @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
    return ColouredPoints(points, np.clip(np.rint(255 * mixture.colours), 0, 255).astype(np.uint8))
