# SPDX-License-Identifier: Apache-2.0
"""An Estimator may be shared by threads, sent to another process, and used in a child after a fork."""

import os
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from box_room import TRUTH, K, room

from garps_core import Config, Estimator, PoseEstimate, Prior, View, estimate_relative_pose
from garps_core.metrics import translation_error_m

PATIENCE_S = 120
"""After so long a child that does not answer is taken for one that hangs."""


@pytest.fixture(scope="module")
def views() -> tuple[View, View]:
    source, target = (room(T) for T in (np.eye(4), TRUTH))
    return View(source[0], K, source[1]), View(target[0], K, target[1])


def answer(estimate: PoseEstimate) -> tuple[str, bytes, bytes]:
    """What must be equal between two estimates of one pair: status, pose and covariance to the last bit."""
    assert estimate.T_target_source is not None and estimate.covariance is not None
    return estimate.status.value, estimate.T_target_source.tobytes(), estimate.covariance.tobytes()


def in_a_child(work: Callable[[], bool]) -> int:
    """Exit code of a forked child: 0 = the work returned True. A child that hangs is ended by a signal."""
    child = os.fork()
    if child == 0:
        signal.alarm(PATIENCE_S)
        try:
            code = 0 if work() else 1
        except BaseException:
            traceback.print_exc(file=sys.__stderr__)
            code = 2
        os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_an_estimator_gives_what_the_function_gives(views: tuple[View, View]) -> None:
    estimate = Estimator().estimate(*views)
    assert estimate.ok and translation_error_m(estimate.T_target_source, TRUTH) < 0.01
    assert answer(estimate) == answer(estimate_relative_pose(*views))


def test_the_mixtures_come_with_it(views: tuple[View, View]) -> None:
    estimate, mixtures = Estimator().estimate_with_mixtures(*views)
    assert estimate.ok and mixtures is not None and all(len(mixture) > 50 for mixture in mixtures)


@pytest.mark.parametrize("preset", ["default", "demo_net"])
def test_a_forked_child_estimates_after_its_parent_has(views: tuple[View, View], preset: str) -> None:
    """A pool of threads or a held lock that the child inherits would let it wait for ever."""
    estimator = Estimator(Config.preset(preset))
    before = answer(estimator.estimate(*views))
    assert in_a_child(lambda: answer(estimator.estimate(*views)) == before) == 0
    assert in_a_child(lambda: answer(estimate_relative_pose(*views, Config.preset(preset))) == before) == 0


def test_a_child_forked_in_the_middle_of_an_alignment_estimates(views: tuple[View, View]) -> None:
    estimator = Estimator()
    before = answer(estimator.estimate(*views))
    stop = threading.Event()

    def busy() -> None:
        while not stop.is_set():
            estimator.estimate(*views)

    with ThreadPoolExecutor(2) as pool:
        jobs = [pool.submit(busy) for _ in range(2)]
        codes = [in_a_child(lambda: answer(estimator.estimate(*views)) == before) for _ in range(3)]
        stop.set()
        for job in jobs:
            job.result()
    assert codes == [0, 0, 0]


@pytest.mark.parametrize("preset", ["default", "monocular"])
def test_four_threads_at_once_get_equal_answers(views: tuple[View, View], preset: str) -> None:
    estimator = Estimator(Config.preset(preset))
    alone = answer(estimator.estimate(*views))
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda _: answer(estimator.estimate(*views)), range(8)))
    assert set(together) == {alone}


def test_an_estimator_travels_to_another_process(views: tuple[View, View]) -> None:
    estimator = Estimator(Config.preset("demo_net"))
    before = answer(estimator.estimate(*views))
    travelled = pickle.loads(pickle.dumps(estimator))
    assert travelled.config == estimator.config and answer(travelled.estimate(*views)) == before
    assert len(pickle.dumps(estimator)) < 20_000, "networks are loaded anew, not sent"


def test_a_prior_is_used(views: tuple[View, View]) -> None:
    prior = Prior(TRUTH, np.eye(6) * 1e-4)
    estimate = Estimator().estimate(*views, prior=prior)
    assert estimate.ok and "given" in estimate.initial.origin
