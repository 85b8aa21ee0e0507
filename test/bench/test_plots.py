# SPDX-License-Identifier: Apache-2.0
"""Plots of a run: what is drawn for which rows, and that a method looks the same everywhere."""

from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("matplotlib")

from bench.report.plots import (
    NothingToDraw,
    error_against,
    error_cdfs,
    looks,
    nees_calibration,
    quality_reliability,
    write_plots,
)
from bench.rows.row import ERRORS

INF = float("inf")


def made_rows(methods: tuple[str, ...] = ("(start)", "garps", "small-gicp"), failures: int = 0) -> list[dict]:
    rng = np.random.default_rng(0)
    rows = []
    for i in range(40):
        same = {"depth": "sensor", "set": "rooms", "start": "none", "pair": f"p{i}", "scale": "metres"}
        same |= {"true_trans_m": 0.1 * (1 + i % 4), "true_overlap": i / 40}
        for k, method in enumerate(methods):
            found = method == "(start)" or i >= failures
            error = float(rng.uniform(0.01, 0.05) * (1 + k)) if found else INF
            row = same | {"method": method, "found": found, "seconds": 0.1 + k} | dict.fromkeys(ERRORS, error)
            own = {"nees": float(rng.chisquare(6)), "quality": float(rng.random())}
            rows.append(row | (own if method == "garps" and found else {}))
    return rows


def test_every_plot_of_every_table(tmp_path: Path) -> None:
    rows = made_rows(failures=5)
    rows += [row | {"start": "disturbed", "set": "other rooms"} for row in rows]
    found = list(write_plots(rows, tmp_path / "plots"))
    names = ["error_cdfs", "error_by_length", "error_by_overlap", "time_against_error"]
    names += ["nees_calibration", "quality_reliability"]
    wanted = [f"sensor_{place}_{name}.png" for place in ("rooms_none", "other_rooms_disturbed") for name in names]
    assert [path.name for path in found] == wanted
    for path in found:
        image = cv2.imread(str(path))
        assert image.shape[0] > 500 and image.std() > 10, path


def test_what_is_not_in_the_rows_is_not_drawn(tmp_path: Path) -> None:
    rows = [
        {name: value for name, value in row.items() if name != "true_overlap"} for row in made_rows(("small-gicp",))
    ]
    names = [path.stem.removeprefix("sensor_rooms_none_") for path in write_plots(rows, tmp_path)]
    assert names == ["error_cdfs", "error_by_length", "time_against_error"]
    for draw in (nees_calibration, quality_reliability):
        with pytest.raises(NothingToDraw):
            draw(rows, tmp_path / "none.png")
    with pytest.raises(NothingToDraw, match="rows with true_overlap"):
        error_against(rows, tmp_path / "none.png", "true_overlap")
    assert not (tmp_path / "none.png").exists()


def test_methods_without_any_pose_are_drawn_as_nothing(tmp_path: Path) -> None:
    """Half failed: no median, but the curve is there; all failed: nothing to scale an axis by."""
    assert error_cdfs(made_rows(failures=25), tmp_path / "half.png").stat().st_size > 0
    with pytest.raises(NothingToDraw, match="errors above zero"):
        error_cdfs(made_rows(("garps",), failures=40), tmp_path / "none.png")
    assert len(list(write_plots(made_rows(failures=40), tmp_path / "plots"))) == 4


def test_a_method_looks_the_same_in_every_picture() -> None:
    few, many = looks(["small-gicp", "garps"]), looks(["icp", "garps", "cpd", "small-gicp", "garps-paper", "(start)"])
    assert few["small-gicp"] == many["small-gicp"] and few["garps"] == many["garps"]
    every = looks(["icp", "cpd", "colmap", "mast3r", "dust3r", "small-gicp", "open3d-gicp", "garps-paper", "garps"])
    assert len({(str(look["color"]), str(look["linestyle"])) for look in every.values()}) == len(every)
