# SPDX-License-Identifier: Apache-2.0
"""Errors of scale that nothing in the pair can show widen the covariance along the translation."""

import numpy as np
import pytest

from garps_core import Config
from garps_core.mixture_alignment import _with_common_scale

T = np.array([[1.0, 0, 0, 2.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize(("method", "sigma"), [("two_view", 0.5), ("auto", 0.3)])
def test_scales_of_the_network_and_of_both_maps_are_combined(method, sigma):
    """0.3 and 0.4 are 0.5 together; the second belongs to the depth of a two-view network only."""
    config = Config().replace(
        {
            "reconstruction.method": method,
            "lifting.common_scale_sigma": 0.3,
            "start.network_scale_sigma": 0.4,
        }
    )
    wider = _with_common_scale(np.zeros((6, 6)), T, config)
    assert wider[0, 0] == pytest.approx((2.0 * sigma) ** 2) and np.count_nonzero(wider) == 1
