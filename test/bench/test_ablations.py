# SPDX-License-Identifier: Apache-2.0
"""Differences with intervals: zero where nothing differs, around the truth elsewhere; the table of an ablation."""

import numpy as np
import pytest

from bench.report.ablations import ablation_tables
from bench.scoring.intervals import paired_difference, relative_change


def test_no_difference_is_zero_and_seeded() -> None:
    values = np.random.default_rng(0).lognormal(size=50)
    assert paired_difference(values, values) == (0, 0, 0) == relative_change(values, values)
    shifted = values * np.random.default_rng(1).uniform(0.8, 1.1, 50)
    assert paired_difference(shifted, values, seed=3) == paired_difference(shifted, values, seed=3)
    assert paired_difference(shifted, values, seed=3) != paired_difference(shifted, values, seed=4)


def test_the_interval_is_that_of_the_normal_law() -> None:
    """For a mean of many values it is +-1.96 standard errors of the differences, which pairing makes small."""
    rng = np.random.default_rng(5)
    common, own = rng.normal(10, 5, 400), rng.normal(0.1, 0.5, 400)
    found = paired_difference(common + own, common)
    error = own.std() / np.sqrt(len(own))
    assert found.value == pytest.approx(own.mean())
    assert (found.low, found.high) == pytest.approx(
        (own.mean() - 1.96 * error, own.mean() + 1.96 * error), abs=0.1 * error
    )


def test_it_covers_the_truth_as_often_as_it_says() -> None:
    rng, inside = np.random.default_rng(6), 0
    for k in range(200):
        values = rng.normal(0, 1, (2, 40))
        low, high = paired_difference(values[0] + 0.3, values[1], draws=400, seed=k)[1:]
        inside += low <= 0.3 <= high
    assert 0.90 <= inside / 200 <= 0.98


def test_sure_and_unsure() -> None:
    a = np.arange(1.0, 21)
    assert paired_difference(a, 2 * a).lower and paired_difference(a, 2 * a, np.median).lower
    assert not paired_difference(2 * a, a).not_higher
    assert paired_difference(a, a[::-1]).not_higher and not paired_difference(a, a[::-1]).lower
    assert relative_change(1.1 * a, a).value == pytest.approx(0.1)
    assert str(paired_difference(a, 2 * a)).startswith("-10.5000 [")


@pytest.mark.parametrize(("a", "b"), [([], []), ([1.0], [1.0, 2.0]), ([np.inf], [1.0]), ([[1.0]], [[1.0]])])
def test_what_cannot_be_compared(a: list, b: list) -> None:
    for compare in (paired_difference, relative_change):
        with pytest.raises(ValueError, match="expected as many finite ones of either"):
            compare(a, b)


def row(pair: int, method: str, error: float) -> dict:
    found = np.isfinite(error)
    errors = dict.fromkeys(("e_trans_m", "e_rot_deg", "e_3d_m"), error)
    return {
        "depth": "given",
        "set": "rooms",
        "start": "none",
        "pair": f"p{pair}",
        "method": method,
        "found": found,
    } | errors


def test_the_table_is_of_the_pairs_that_both_have() -> None:
    rows = [row(i, "garps", 1.0 + i) for i in range(4)] + [row(i, "sift-pnp", 9.0) for i in range(4)]
    rows += [row(i, "garps-isotropic", 1.5 * (1 + i) if i < 3 else np.inf) for i in range(4)]
    text = ablation_tables(rows)
    (line,) = [line for line in text.splitlines() if line.startswith("| garps-isotropic")]
    assert "| 3 of 4 | +50.0 % [+50.0, +50.0] | +50.0 % " in line and "sift-pnp" not in text
    assert ablation_tables([r for r in rows if r["method"] != "garps-isotropic"]) == ""
