# SPDX-License-Identifier: Apache-2.0
"""The ladders narrow from rung to rung and take more components; their numbers are named."""

from itertools import pairwise

import pytest

from garps_core.config import PRESETS, Config, Rung


def test_the_numbers_of_a_rung_are_named() -> None:
    with pytest.raises(TypeError, match="positional"):
        Rung(1000.0, 500)  # type: ignore[call-arg]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("ladder", ["ladder", "search", "search_ladder"])
def test_a_ladder_narrows_and_takes_more_components(preset: str, ladder: str) -> None:
    rungs = getattr(Config.preset(preset).alignment, ladder)
    for wide, narrow in pairwise(rungs):
        assert (
            narrow.covariance_scale < wide.covariance_scale
            or narrow.blur_m < wide.blur_m
            or (narrow.occlusion_ratio < wide.occlusion_ratio)
        )
        assert narrow.components >= wide.components
