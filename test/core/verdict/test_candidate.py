# SPDX-License-Identifier: Apache-2.0
"""The best candidate has evidence of brightness, and a convincing one ends the search and is returned."""

from dataclasses import replace

import numpy as np
import pytest
from candidates import candidate

from garps_core.config import Alignment
from garps_core.verdict.candidate import CONVINCING_SHARE, best_candidate

SETTINGS = Alignment()


def test_merit_is_agreement_times_shared_share():
    assert candidate(correlation=0.9, share=0.5).merit == pytest.approx(0.45)
    assert candidate(correlation=None, overlap=0.4).merit == pytest.approx(3.0 * 0.4)


def test_a_candidate_that_lost_its_brightness_does_not_beat_one_that_has_it():
    """Objective times overlap is above 1, correlation times share below."""
    blank_wall, good = candidate(correlation=None), candidate(correlation=0.9)
    assert blank_wall.merit > 2 > 1 > good.merit
    for order in ([blank_wall, good], [good, blank_wall]):
        assert best_candidate(order, SETTINGS) is good
    better = candidate(correlation=None, overlap=0.9)
    assert best_candidate([blank_wall, better], SETTINGS) is better


def test_a_correlation_over_a_sliver_does_not_convince():
    assert candidate(correlation=0.96, share=0.5).convincing(SETTINGS)
    for poor in ({"share": 0.1}, {"overlap": 0.1}, {"correlation": 0.94}, {"correlation": None}):
        assert not candidate(**({"correlation": 0.96, "share": 0.5} | poor)).convincing(SETTINGS), poor
    just = candidate(correlation=0.96, share=CONVINCING_SHARE)
    assert just.convincing(SETTINGS)
    assert not just.convincing(replace(SETTINGS, min_overlap=CONVINCING_SHARE + 0.01)), "it would be refused"


def test_the_search_goes_on_after_a_sliver_and_ends_with_a_convincing_candidate():
    sliver, right = candidate(correlation=0.99, share=0.1), candidate(correlation=0.96, share=0.5)
    asked = []

    def found():
        for one in (sliver, right, candidate()):
            asked.append(one)
            yield one

    assert best_candidate(found(), SETTINGS) is right
    assert asked == [sliver, right]


def test_the_convincing_candidate_is_returned_although_another_ranks_higher():
    wide = candidate(correlation=0.9, share=1.0)
    convincing = candidate(correlation=0.96, share=0.5)
    assert wide.rank > convincing.rank
    assert best_candidate([wide, convincing], SETTINGS) is convincing


def test_no_candidate_is_none_and_the_first_of_equals_is_kept():
    assert best_candidate([], SETTINGS) is None
    equals = [candidate(T=np.eye(4)), candidate(T=np.eye(4))]
    assert best_candidate(equals, replace(SETTINGS, enough_correlation=1.0)) is equals[0]
