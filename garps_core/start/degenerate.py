# SPDX-License-Identifier: Apache-2.0
"""A pose that its measurements leave open: a reason not to start from it, not an error of the program."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from garps_core.errors import InitialisationError, InputError


@contextmanager
def fixed_pose(measurements: str) -> Iterator[None]:
    """Raise InitialisationError where the linear algebra inside fails, or no valid `Prior` comes of it.

    Args:
        measurements: what the pose is computed from, e.g. "8 feature matches, 8 inliers".
    """
    try:
        yield
    except (np.linalg.LinAlgError, InputError) as error:
        raise InitialisationError(
            f"{measurements}, but they fix no pose: its covariance cannot be computed. Show both cameras more of the "
            "same scene, or give a prior."
        ) from error
