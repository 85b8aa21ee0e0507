# SPDX-License-Identifier: Apache-2.0
"""Choosing settings: what is searched exists, and the loss prefers what a user would."""

import math

import pytest
import typer
from typer.testing import CliRunner

from garps_core import Config
from garps_core.config.text import read_settings

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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--depth", "sonar"], "'sonar': expected one of sensor, monocular, demo_net"),
        (["--depth", "demo_net", "--data", "pairs=x"], "no data to tune demo_net on: give --data rooms=FOLDER"),
        (["--data", "x"], "expected NAME=FOLDER"),
        (["--data", "pairs=nowhere"], "No such file"),
    ],
)
def test_mistakes_are_one_line(words, message, tmp_path):
    code, printed = called(*words, "--out", tmp_path)
    assert code == 2 and message in printed and "Traceback" not in printed


def called(*words):
    app = typer.Typer()
    app.command()(tune.main)
    found = CliRunner().invoke(app, [str(word) for word in words])
    assert found.exception is None or isinstance(found.exception, SystemExit), found.exception
    return found.exit_code, " ".join(found.output.split())


@pytest.mark.usefixtures("one_thread")
def test_a_study_goes_on_and_leaves_settings_that_load(tmp_path):
    """Two rooms, of which one decides and the other is reported on; a trial, and one more of the same study."""
    pytest.importorskip("embreex")
    from bench_command import write_rooms

    words = ["--data", f"pairs={write_rooms(tmp_path / 'rooms')}", "--trials", "1", "--out", tmp_path / "out"]
    code, printed = called(*words)
    assert code == 0 and "1 trials, best" in printed, printed
    code, printed = called(*words)
    assert code == 0 and "2 trials, best" in printed and "held-out: loss" in printed, printed
    settings = read_settings(tmp_path / "out" / "sensor.yaml", Config()).settings()
    assert {name for name, value in Config().settings().items() if settings[name] != value} <= set(
        tune.SPACES["sensor"]
    )
    assert called("--data", f"pairs={tmp_path / 'rooms'}", "--trials", "0", "--out", tmp_path / "out")[0] == 0
    code, printed = called(*words, "--limit", "2")
    assert code == 2 and "is of other pairs or settings" in printed
    code, printed = called(*words[:2], "--trials", "0", "--out", tmp_path / "new")
    assert code == 2 and "no finished trial of sensor" in printed
