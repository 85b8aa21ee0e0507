# SPDX-License-Identifier: Apache-2.0
"""Choosing settings: what is searched exists, and the loss prefers what a user would."""

import math

import pytest

from garps_core import Config

pytest.importorskip("optuna")
from bench import tune


def rows(error_m=0.01, nees=5.0, count=20, **other):
    row = {"e_3d_m": error_m, "e_trans_m": error_m, "e_rot_deg": 0.5, "nees": nees}
    return [row | other for _ in range(count - 1)] + [row | {"nees": 20.0}]


@pytest.mark.parametrize("depth", tune.SPACES)
def test_presets_lie_inside_what_is_searched(depth):
    settings = Config.preset(depth).settings()
    for name, (low, high) in tune.SPACES[depth].items():
        assert low < settings[name] < high, name


def test_the_loss_is_of_the_errors():
    assert tune.loss_of([rows(0.01)]) == pytest.approx(2 * math.log10(0.01))
    assert tune.loss_of([rows(0.01), rows(0.1)]) == pytest.approx(-3.0)
    assert tune.loss_of([rows(1e-9)]) == pytest.approx(tune.loss_of([rows(1e-3)])), "no gain below a millimetre"
    assert tune.loss_of([rows(math.inf)]) == pytest.approx(1 + 0.0)


def test_failures_and_overconfidence_cost():
    right = tune.loss_of([rows()])
    assert tune.loss_of([rows(e_rot_deg=6.0)]) == pytest.approx(right + 0.95, abs=0.06)
    assert tune.loss_of([rows(nees=30.0)]) > right + 15, "none inside its bound"
    assert tune.loss_of([[row | {"nees": 1.0} for row in rows()]]) == pytest.approx(right + 0.5), "too careful"


def test_an_unknown_depth_is_named(capsys):
    with pytest.raises(Exception, match="2"):
        tune.main(depth="sonar", trials=0)
    assert "'sonar': expected one of sensor, monocular" in " ".join(capsys.readouterr().out.split())
