# SPDX-License-Identifier: Apache-2.0
"""Annealing ladders: the rungs that an alignment goes through, from wide kernels to narrow ones."""

from __future__ import annotations

from dataclasses import dataclass

from garps_core.config.field import Checked, setting


@dataclass(frozen=True, kw_only=True)
class Rung(Checked):
    """One step of an annealing ladder."""

    covariance_scale: float = setting(1.0, "factor on the covariance of every component", low=1e-3, high=1e4)
    components: int = setting(4000, "number of components used per view", low=50, high=1_000_000)
    neighbours: int = setting(10, "number of nearest neighbours per component", low=1, high=200)
    steps: int = setting(5, "largest number of solver steps", low=1, high=100_000)
    blur_m: float = setting(
        0.0, "sigma of an isotropic blur of a pair of components, so that far surfaces pull", unit="m", low=0, high=100
    )
    outlier_floor: float = setting(
        0.0,
        "replacement of `alignment.outlier_floor`, 0 = not replaced; with a small one far partners pull",
        low=0,
        high=10,
    )
    occlusion_ratio: float = setting(
        0.0,
        "replacement of `alignment.occlusion_ratio`, 0 = not replaced; with a large one a pose far off hides nothing",
        low=0,
        high=1000,
    )


# fmt: off
_NARROWING = (
    Rung(covariance_scale=100.0, components=1500, neighbours=20, steps=8),
    Rung(covariance_scale=30.0,  components=2000, neighbours=15, steps=8),
    Rung(covariance_scale=10.0,  components=3000, neighbours=12, steps=8),
    Rung(covariance_scale=4.0,   components=4000, neighbours=12, steps=8),
    Rung(covariance_scale=2.0,   components=5000, neighbours=12, steps=20),
)

SENSOR = (
    Rung(covariance_scale=1000.0, components=800,  neighbours=20, steps=8),
    Rung(covariance_scale=300.0,  components=1000, neighbours=20, steps=8),
    *_NARROWING,
)
"""Ladder from a start pose, for depth of a sensor.

It begins at 1000, which widens a footprint of 3 mm to a decimetre: begun at 100, starts that are 6 to 8 degrees off led
to wrong optima. It ends at 2, because narrower kernels were less accurate. The last rung may take 20 steps, so that the
pose comes to rest on it. A precise start skips the wide rungs.
"""

SEARCH = (
    Rung(
        covariance_scale=1000.0, components=400, neighbours=40, steps=8,
        blur_m=0.3, outlier_floor=1e-4, occlusion_ratio=100.0,
    ),
)
"""Ladder that ranks the starting poses of a search: one coarse rung.

Its blur of 0.3 m lets surfaces pull from where a guess leaves them, and its small outlier floor keeps that pull at a
distance. Its occlusion ratio hides nothing: half a metre off, most components seem hidden, also those that pull the
right way.
"""

_FROM_A_GUESS = (
    Rung(
        covariance_scale=1000.0, components=500, neighbours=40, steps=10,
        blur_m=0.08, outlier_floor=1e-4, occlusion_ratio=100.0,
    ),
    Rung(covariance_scale=100.0, components=1000, neighbours=20, steps=8, occlusion_ratio=100.0),
)

SENSOR_SEARCH = (*_FROM_A_GUESS, *_NARROWING)
"""Ladder from a pose that a search has found, for depth of a sensor.

Its first two rungs still hide nothing, and the first is blurred by 8 cm in place of the 0.3 m of `SEARCH`. It ends like
`SENSOR`.
"""

NETWORK = (
    Rung(covariance_scale=100.0, components=1000, neighbours=20, steps=8),
    Rung(covariance_scale=30.0,  components=1500, neighbours=20, steps=8),
    Rung(covariance_scale=10.0,  components=2000, neighbours=15, steps=10),
    Rung(covariance_scale=4.0,   components=3000, neighbours=15, steps=15),
)
"""Ladder from a start pose, for depth of a network.

Components of such depth are about ten times as long along the ray as a sensor's (3 % of the range against 0.3 %). The
ladder therefore begins at 100 and ends at 4, where narrower kernels would follow the errors of the depth.
"""

NETWORK_SEARCH = (*_FROM_A_GUESS, *NETWORK[1:])
"""Ladder from a pose that a search has found, for depth of a network."""

# fmt: on
