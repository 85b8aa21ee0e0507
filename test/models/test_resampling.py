# SPDX-License-Identifier: Apache-2.0
"""Pictures are resized as the library did it that prepared them for the training of the networks, to the last bit."""

import golden_rule
import numpy as np
import pytest

from garps_core.models.resampling import bicubic, lanczos

SIZES = {
    "shrunk": ((360, 640), (288, 512)),
    "enlarged": ((120, 160), (384, 512)),
    "shrunk and enlarged": ((50, 900), (64, 512)),
    "far": ((700, 900), (17, 23)),
    "one pixel": ((1, 1), (16, 24)),
    "to one pixel": ((33, 20), (1, 1)),
    "unchanged": ((48, 64), (48, 64)),
}


@pytest.mark.parametrize(("size", "wanted"), SIZES.values(), ids=SIZES)
@pytest.mark.parametrize("filtered", [lanczos, bicubic], ids=["lanczos", "bicubic"])
def test_every_byte_is_that_of_pillow(filtered, size, wanted) -> None:
    pillow = pytest.importorskip("PIL.Image")
    rgb = golden_rule.image(*size)
    noise = np.random.default_rng(0).integers(0, 2, (*size, 3), np.uint8) * 255  # overshoots
    method = getattr(pillow.Resampling, filtered.__name__.upper())
    for picture in (rgb, noise):
        theirs = np.asarray(pillow.fromarray(picture).resize(wanted[::-1], method))
        np.testing.assert_array_equal(filtered(picture, *wanted), theirs)
        assert (filtered(picture, *wanted) == picture).all() if size == wanted else True


def test_a_constant_picture_stays_constant() -> None:
    for value in (0, 1, 254, 255):
        rgb = np.full((31, 57, 3), value, np.uint8)
        assert (lanczos(rgb, 97, 20) == value).all()
        assert (bicubic(rgb, 97, 20) == value).all()
