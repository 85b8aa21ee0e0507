# SPDX-License-Identifier: Apache-2.0
"""The path of an image in the docstring of `garps_ros.live` names functions that exist."""

import importlib
import re
from functools import reduce

import pytest

from garps_ros import live

pytest.importorskip("rclpy")
STOPS = re.findall(r"^\d+\. `([\w.]+)`", live.__doc__, re.MULTILINE)


@pytest.mark.parametrize("stop", STOPS)
def test_every_stop_of_the_path_exists(stop):
    folder, module, names = re.fullmatch(r"((?:\w+\.)*?)(\w+)\.([A-Z]\w*\.\w+|\w+)", stop).groups()
    found = importlib.import_module((folder or "garps_ros.live.") + module)
    assert callable(reduce(getattr, names.split("."), found))


def test_the_path_has_all_its_stops():
    assert len(STOPS) == 12 and STOPS[0].startswith("subscriptions.") and STOPS[-1].startswith("publishers.")
