# SPDX-License-Identifier: Apache-2.0
"""From a guess and two images, brightness alone leads near the pose from far away, or gives none."""

from dataclasses import replace

import numpy as np
import pytest
from surfaces import off, room

from garps_core import Config
from garps_core.mixture_alignment import weighted_start
from garps_core.mixtures.reconstruct import reconstruct
from garps_core.solver import search
from garps_core.solver.brightness_search import CONTINUED, search_by_brightness
from garps_core.start.identity_start import identity

START = weighted_start(identity(Config(), ""), Config())
AROUND = search.starting_poses(START, search.FINE_RINGS)


def frustums(seed, level):
    source, target, truth = room(seed, level)
    return reconstruct(source).frustum, reconstruct(target).frustum, truth


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_best_end_is_within_a_few_degrees_where_the_guess_was_twenty_off(seed):
    source, target, truth = frustums(seed, 4)
    assert np.degrees(off(np.eye(4), truth)[1]) > 19
    found = search_by_brightness(source, target, START, AROUND)
    assert 1 <= len(found) <= CONTINUED
    assert np.degrees(min(off(T, truth)[1] for T in found[:3])) < 6


def test_the_order_is_that_of_agreement_not_of_the_starting_poses():
    source, target, _ = frustums(1, 4)
    found, backwards = (search_by_brightness(source, target, START, poses) for poses in (AROUND, AROUND[::-1]))
    np.testing.assert_allclose(found[0], backwards[0], atol=1e-9)


def test_without_brightness_or_contrast_there_is_none():
    source, target, _ = frustums(1, 1)
    assert search_by_brightness(source, target, START, AROUND)
    assert search_by_brightness(replace(source, brightness=None), target, START, AROUND) == []
    flat = np.full_like(source.brightness, 0.5)
    assert search_by_brightness(replace(source, brightness=flat), replace(target, brightness=flat), START, AROUND) == []
