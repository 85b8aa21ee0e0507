# SPDX-License-Identifier: Apache-2.0
"""Settings for the whole suite; they must stand before anything imports a message class."""

import os

import pytest
from hypothesis import settings

# Without this, Jazzy accepts a scalar of the wrong type and publishes garbage for it.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"

# No deadline: a shared machine may stall for longer than any example takes. The same examples every time, so that a
# change is judged by what it changes; GARPS_TEST_PROFILE=explore looks for new ones.
settings.register_profile("garps", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None, max_examples=1000)
settings.load_profile(os.environ.get("GARPS_TEST_PROFILE", "garps"))


@pytest.fixture(scope="module")
def domain(tmp_path_factory):
    """A ROS domain that nobody else on this machine uses, for the tests of one file."""
    from graph import private_domain

    with private_domain(tmp_path_factory.mktemp("ros")) as held:
        yield held
