# SPDX-License-Identifier: Apache-2.0
"""`python -m bench.demo_basin`: how far off a given pose may be before the alignment ends in a wrong place.

Three generated rooms (10 degrees and 0.25 m between the views, 320x240, sensor-like depth), three disturbances of each
size, given as a prior with sigmas of that size. Right = within 20 mm and 0.5 degrees of the truth.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from bench.rooms import RoomPair, make_pair
from garps_core import Config, Prior, Status, View, estimate_relative_pose, metrics

ROOMS, LEVEL = (1, 3, 5), 2
SIZES = ((0.2, 0.0), (0.4, 0.0), (0.6, 0.0), (0.0, 5.0), (0.0, 10.0), (0.0, 15.0), (0.2, 6.0), (0.4, 12.0))
"""Metres and degrees that the given pose is off, about the source camera."""
REPEATS = 3
RIGHT_M, RIGHT_DEG = 0.02, 0.5


def off_by(pair: RoomPair, metres: float, degrees: float, rng: np.random.Generator) -> Prior:
    """The truth moved and turned in random directions, with sigmas of that size (at least 0.02 m and 0.01 rad)."""
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    T: npt.NDArray[np.float64] = pair.T_1_0.copy()
    T[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix() @ T[:3, :3]
    T[:3, 3] += metres * way
    sigmas = np.repeat([max(metres, 0.02), max(float(np.radians(degrees)), 0.01)], 3)
    return Prior(T, np.diag(sigmas**2))


def main() -> None:
    """Print the table: without features, which would find most of these poses by themselves."""
    config = Config().replace({"start.features": False})
    table = Table(title="Given pose off by ... : what came of it")
    for heading in ("m", "deg", "right", "right & converged", "wrong & converged"):
        table.add_column(heading, justify="right")
    pairs = [make_pair(seed, LEVEL, width=320, height=240, depth_noise="sensor") for seed in ROOMS]
    for metres, degrees in SIZES:
        outcomes = []
        for pair, seed in zip(pairs, ROOMS, strict=True):
            views = View(pair.rgb0, pair.K0, pair.depth0), View(pair.rgb1, pair.K1, pair.depth1)
            rng = np.random.default_rng([seed, round(1000 * metres), round(10 * degrees)])
            for _ in range(REPEATS):
                found = estimate_relative_pose(*views, config, prior=off_by(pair, metres, degrees, rng))
                T = found.T_target_source
                right = T is not None and (
                    metrics.translation_error_m(T, pair.T_1_0) < RIGHT_M
                    and metrics.rotation_error_deg(T, pair.T_1_0) < RIGHT_DEG
                )
                outcomes.append((right, found.status is Status.CONVERGED))
        counts = [sum(o) for o in zip(*((r, r and c, c and not r) for r, c in outcomes), strict=True)]
        table.add_row(f"{metres:g}", f"{degrees:g}", *(f"{count}/{len(outcomes)}" for count in counts))
    Console().print(table)


if __name__ == "__main__":
    main()
