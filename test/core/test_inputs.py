# SPDX-License-Identifier: Apache-2.0
"""What cannot be right is refused by name: what was given, what was expected, and what to do about it."""

import re
from dataclasses import replace

import numpy as np
import pytest
from surfaces import FREE, look, random_mixture

from garps_core import (
    Config,
    ConfigError,
    GarpsError,
    InputError,
    Mixture,
    Prior,
    ReconstructionError,
    Status,
    View,
    align_mixtures,
    estimate_relative_pose,
)
from garps_core.config import Alignment, Rung
from garps_core.config.lifting import Lifting
from garps_core.errors import MissingDepthError
from garps_core.mixtures.reconstruct import reconstruct

RGB = np.zeros((48, 64, 3), np.uint8)
K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
DEPTH = np.full((48, 64), 2.0, np.float32)


def view(rgb=RGB, K=K, depth=DEPTH):
    return View(rgb, K, depth)


def changed(array, index, value):
    """A float copy of `array` with one entry replaced."""
    copy = np.array(array, np.float64)
    copy[index] = value
    return copy


def few_readings(count):
    """A flat wall of which only the first `count` columns of a sampled row are left."""
    depth = np.full_like(DEPTH, np.nan)
    depth[8:11, : 2 * count] = 2.0
    return view(depth=depth)


def mixture(**parts):
    return replace(random_mixture(0, 60), **parts)


GOOD = random_mixture(0, 60)
PRIOR = Prior(np.eye(4), FREE)
INDEFINITE = changed(np.eye(6), (0, 1), 2) + changed(np.zeros((6, 6)), (1, 0), 2)

VIEWS = {
    "rgb list": (lambda: view(rgb=[[0, 0, 0]]), "rgb is list: expected an HxWx3 uint8 array"),
    "rgb float": (lambda: view(rgb=RGB / 255), "rgb is dtype float64: expected an HxWx3 uint8 array, values 0..255"),
    "rgb grey": (lambda: view(rgb=RGB[..., 0]), r"shape \(48, 64\): expected HxWx3. Repeat a grey image over three"),
    "rgb with alpha": (lambda: view(rgb=np.zeros((48, 64, 4), np.uint8)), r"shape \(48, 64, 4\): expected HxWx3"),
    "rgb planes first": (lambda: view(rgb=np.zeros((3, 48, 64), np.uint8)), r"shape \(3, 48, 64\): expected HxWx3"),
    "rgb tiny": (lambda: view(rgb=RGB[:15]), "rgb is 64x15: expected at least 16x16"),
    "rgb huge": (
        lambda: view(rgb=np.broadcast_to(RGB[:1, :1], (8193, 8193, 3))),
        "8193x8193: expected .* at most 67108864 pixels",
    ),
    "K 3x4": (lambda: view(K=np.eye(3, 4)), r"K has shape \(3, 4\): expected 3x3"),
    "K flat": (lambda: view(K=K.ravel()), r"K has shape \(9,\): expected 3x3"),
    "K text": (lambda: view(K="fx"), "K has dtype .*: expected real numbers"),
    "K ragged": (lambda: view(K=[[1, 2], [3]]), "K is no array .*: expected numbers"),
    "K NaN": (lambda: view(K=changed(K, (0, 2), np.nan)), "K holds NaN or infinity: expected finite"),
    "K infinite": (lambda: view(K=changed(K, (0, 0), np.inf)), "K holds NaN or infinity: expected finite"),
    "K zeros": (lambda: view(K=np.zeros((3, 3))), "fx=0, fy=0: expected both positive, .* calibrate it first"),
    "K negative focal": (lambda: view(K=changed(K, (1, 1), -50)), "fx=50, fy=-50: expected both positive"),
    "K transposed": (lambda: view(K=K.T), r"last row \[32.0, 24.0, 1.0\]: expected \[0, 0, 1\].* Is it transposed"),
    "K skew": (lambda: view(K=changed(K, (0, 1), 0.5)), "K has skew 0.5: expected 0; rectify the image first"),
    "K scaled": (lambda: view(K=2 * K), r"last row \[0.0, 0.0, 2.0\]: expected \[0, 0, 1\]"),
    "depth uint16": (
        lambda: view(depth=np.full((48, 64), 2000, np.uint16)),
        r"depth is dtype uint16: expected HxW float32 metres; for millimetres use np.where\(mm > 0, mm \* 0.001",
    ),
    "depth list": (lambda: view(depth=[[2.0]]), "depth is list: expected HxW float32 metres"),
    "depth half": (lambda: view(depth=DEPTH.astype(np.float16)), "depth is dtype float16: expected HxW float32"),
    "depth of another size": (lambda: view(depth=DEPTH[::2, ::2]), "depth is 24x32 but rgb is 48x64 .*: expected"),
    "depth transposed": (lambda: view(depth=DEPTH.T), "depth is 64x48 but rgb is 48x64 .*: expected"),
    "depth with channel": (lambda: view(depth=DEPTH[..., None]), "depth is 48x64x1 but rgb is 48x64"),
    "depth negative": (lambda: view(depth=-DEPTH), "depth holds negative values: expected metres along z"),
    "depth millimetres": (lambda: view(depth=DEPTH * 1000), "median 2000 m: .*millimetres; expected .* by 0.001"),
    "depth kilometres": (lambda: view(depth=DEPTH / 1000), "median 0.002 m: expected metres. Is it a disparity"),
}

PRIORS = {
    "pose 3x4": (lambda: Prior(np.eye(3, 4), FREE), r"T_target_source has shape \(3, 4\): expected a 4x4 rigid"),
    "pose scaled": (lambda: Prior(np.diag([1.1, 1.1, 1.1, 1]), FREE), "no rigid motion: .*expected a right-handed"),
    "pose mirrored": (lambda: Prior(np.diag([1.0, 1, -1, 1]), FREE), "det R = -1; expected a right-handed rotation"),
    "pose sheared": (lambda: Prior(changed(np.eye(4), (0, 1), 0.1), FREE), "R.T R differs from identity by 0.1"),
    "pose last row": (lambda: Prior(changed(np.eye(4), (3, 0), 1), FREE), r"last row \[1.0, .*: expected \[0, 0, 0, 1"),
    "pose transposed": (lambda: Prior(changed(np.eye(4), (0, 3), 2).T, FREE), "has last row .*: expected"),
    "pose NaN": (lambda: Prior(changed(np.eye(4), (0, 3), np.nan), FREE), "holds NaN or infinity: expected a finite"),
    "pose objects": (lambda: Prior([[None] * 4] * 4, FREE), "T_target_source has dtype object: expected real numbers"),
    "covariance 3x3": (
        lambda: Prior(np.eye(4), np.eye(3)),
        r"prior covariance has shape \(3, 3\): expected 6x6 \(x, y",
    ),
    "covariance diagonal only": (lambda: Prior(np.eye(4), np.ones(6)), r"has shape \(6,\): expected 6x6"),
    "covariance zero": (
        lambda: Prior(np.eye(4), np.zeros((6, 6))),
        "not positive definite: .* zeros do not mean unknown. Give every direction a positive variance",
    ),
    "covariance indefinite": (lambda: Prior(np.eye(4), INDEFINITE), "not positive definite: smallest eigenvalue -1"),
    "covariance asymmetric": (
        lambda: Prior(np.eye(4), changed(np.eye(6), (0, 1), 0.5)),
        "not symmetric: largest difference 0.5, expected 0",
    ),
    "covariance NaN": (lambda: Prior(np.eye(4), changed(FREE, (2, 2), np.nan)), "NaN or infinity: expected finite var"),
    "covariance infinite": (lambda: Prior(np.eye(4), changed(FREE, (2, 2), np.inf)), "Use a large one for unknown"),
}

MIXTURES = {
    "means scalar": (lambda: mixture(means=1.0), r"means have shape \(\): expected Nx3"),
    "means 4 columns": (lambda: mixture(means=np.zeros((60, 4))), r"means have shape \(60, 4\): expected \(60, 3\)"),
    "means text": (lambda: mixture(means=np.full((60, 3), "a")), "means has dtype <U1: expected real numbers"),
    "means NaN": (lambda: mixture(means=changed(GOOD.means, 5, np.nan)), "means hold NaN or infinity: expected finite"),
    "counts differ": (
        lambda: mixture(weights=np.ones(59)),
        r"weights have shape \(59,\): expected \(60,\) for 60 comp",
    ),
    "weights negative": (lambda: mixture(weights=-GOOD.weights), "weights are negative or all zero: expected non-neg"),
    "weights zero": (lambda: mixture(weights=np.zeros(60)), "weights are negative or all zero: expected .* positive"),
    "colours bytes": (
        lambda: mixture(colours=GOOD.colours * 255),
        r"colours span .*\.\..*: expected 0..1; divide bytes",
    ),
    "colours negative": (lambda: mixture(colours=-GOOD.colours), r"colours span -.*: expected 0..1"),
    "covariances diagonal only": (
        lambda: mixture(covariances=np.ones((60, 3))),
        r"covariances have shape \(60, 3\): expected \(60, 3, 3\)",
    ),
    "covariance indefinite": (
        lambda: mixture(covariances=changed(GOOD.covariances, 7, np.diag([1, 1, -1]))),
        r"component 7 has eigenvalue -1 m\^2: expected positive definite. Add a small variance",
    ),
    "covariance asymmetric": (
        lambda: mixture(covariances=changed(GOOD.covariances, (7, 0, 1), 9)),
        "covariances are not symmetric: expected",
    ),
    "covariance infinite": (lambda: mixture(covariances=changed(GOOD.covariances, 7, np.inf)), "covariances hold NaN"),
    "labels float": (lambda: mixture(labels=np.ones(60)), r"labels have shape \(60,\), float64: expected 60 integers"),
    "labels short": (lambda: mixture(labels=np.ones(3, int)), r"labels have shape \(3,\), int64: expected 60 integers"),
    "49 components": (
        lambda: align_mixtures(GOOD, random_mixture(0, 49), PRIOR),
        "target has 49 components: expected at least 50. Use a smaller stride",
    ),
    "no components": (
        lambda: align_mixtures(random_mixture(0, 0), GOOD, PRIOR),
        "source has 0 components: expected at least 50",
    ),
}

SETTINGS = {
    "unknown preset": (lambda: Config.preset("papr"), "preset 'papr' does not exist: expected one of default, sensor"),
    "misspelt": (
        lambda: Config().replace({"lifting.strid": 4}),
        "'lifting.strid' does not exist; did you mean 'lifting",
    ),
    "no part": (
        lambda: Config().replace({"effective_measurements": 4}),
        "did you mean 'alignment.effective_measurements'",
    ),
    "nothing like it": (
        lambda: Config().replace({"zzzzzz": 4}),
        "'zzzzzz' does not exist; expected a name of docs/param",
    ),
    "below a leaf": (lambda: Config().replace({"seed.value": 4}), "setting 'seed.value' does not exist"),
    "below range": (
        lambda: Config().replace({"lifting.stride": 0}),
        "lifting.stride is 0: expected between 1 and 32 px",
    ),
    "above range": (lambda: Config().replace({"start.match_ratio": 1.5}), "is 1.5: expected between 0.1 and 1"),
    "NaN": (lambda: Lifting(noise_linear=float("nan")), "lifting.noise_linear is nan: expected between 0 and 1 m/m"),
    "infinite": (
        lambda: Alignment(effective_measurements=float("inf")),
        "alignment.effective_measurements is inf: expected between",
    ),
    "float for integer": (lambda: Lifting(stride=2.0), "lifting.stride is 2.0: expected an integer"),
    "text for number": (lambda: Lifting(noise_linear="1"), "lifting.noise_linear is '1': expected a number"),
    "flag for number": (lambda: Config(seed=True), "config.seed is True: expected an integer"),
    "number for flag": (
        lambda: Config().replace({"start.identity_fallback": 1}),
        "start.identity_fallback is 1: expected True or False",
    ),
    "wrong choice": (lambda: Config(dtype="float16"), "config.dtype is 'float16': expected one of float32, float64"),
    "wrong method": (lambda: Config(method="lm"), "method is 'lm': expected one of garps, paper"),
    "device number": (lambda: Config(device=0), "config.device is 0: expected text"),
    "part of another kind": (lambda: Config(lifting=Alignment()), "config.lifting is .*: expected Lifting"),
    "ladder empty": (lambda: Alignment(ladder=()), r"alignment.ladder is \(\): expected a tuple of at least one Rung"),
    "ladder of numbers": (lambda: Alignment(ladder=(1, 2)), r"ladder is \(1, 2\): expected a tuple of .* Rung"),
    "ladder list": (lambda: Alignment(ladder=[Rung()]), "alignment.ladder is .*: expected a tuple"),
    "no such device": (
        lambda: align_mixtures(GOOD, GOOD, PRIOR, Config(device="nonsense")),
        "device is 'nonsense', which is not there: expected one of cpu.*. Set device to 'cpu'",
    ),
    "no such device number": (
        lambda: align_mixtures(GOOD, GOOD, PRIOR, Config(device="cuda:99")),
        "device is 'cuda:99', which is not there: expected one of cpu",
    ),
    "device without data": (
        lambda: align_mixtures(GOOD, GOOD, PRIOR, Config(device="meta")),
        "device is 'meta', which is not there: expected one of cpu",
    ),
    "device of the whole pipeline": (
        lambda: estimate_relative_pose(view(), view(), Config(device="nonsense")),
        "device is 'nonsense', which is not there: expected one of cpu.*. Set device to 'cpu'",
    ),
}

WITHOUT_DEPTH = {
    "no depth": (
        lambda: reconstruct(view(depth=None)),
        r"the view has no depth: expected .*. Give View\(\.\.\., depth=",
    ),
    "pipeline, source": (lambda: estimate_relative_pose(view(depth=None), view()), "the view has no depth: expected"),
    "pipeline, target": (lambda: estimate_relative_pose(view(), view(depth=None)), "the view has no depth: expected"),
}

RECONSTRUCTIONS = {
    "all NaN": (
        lambda: reconstruct(view(depth=DEPTH * np.nan)),
        r"0 usable depth pixels of 3072 \(0 with a reading\): expected at least 50. Check",
    ),
    "all zero": (lambda: reconstruct(view(depth=DEPTH * 0)), r"\(0 with a reading\): expected at least 50"),
    "40 pixels": (lambda: reconstruct(few_readings(20)), r"40 with a reading|120 with a reading"),
    "out of range": (
        lambda: reconstruct(view(depth=DEPTH * 20)),
        r"0 usable depth pixels of 3072 \(3072 with a reading\): expected at least 50. Check range limits",
    ),
    "one edge": (
        lambda: reconstruct(view(depth=np.where(np.arange(64) % 2, 2, 4) * np.ones((48, 1), np.float32))),
        r"0 usable .* \(3072 with a reading\): .*the scene is not one edge",
    ),
}

CASES = {
    f"{kind.__name__}, {name}": (make, match, kind)
    for kind, table in (
        (InputError, {**VIEWS, **{f"prior {n}": c for n, c in PRIORS.items()}, **MIXTURES}),
        (ConfigError, SETTINGS),
        (MissingDepthError, WITHOUT_DEPTH),
        (ReconstructionError, RECONSTRUCTIONS),
    )
    for name, (make, match) in table.items()
}


@pytest.mark.parametrize("name", CASES)
def test_what_cannot_be_right_is_refused_by_name(name):
    make, match, kind = CASES[name]
    with pytest.raises(GarpsError, match=match) as caught:
        make()
    assert type(caught.value) is kind
    text = str(caught.value)
    assert "expected" in text or "did you mean" in text, "says what would be right"
    assert re.search(r" (is|are|has|have|hold|holds|span|does) ", text), "says what was given"
    assert "\n" not in text and len(text) < 300, "one line, without arrays written out"


def test_the_table_is_the_size_it_claims():
    tables = (VIEWS, PRIORS, MIXTURES, SETTINGS, WITHOUT_DEPTH, RECONSTRUCTIONS)
    assert len(CASES) == sum(map(len, tables)) >= 85, "a name was used twice"


@pytest.mark.parametrize("depth", [DEPTH * np.nan, DEPTH * 0, DEPTH * 20], ids=["unknown", "zero", "out of range"])
@pytest.mark.parametrize("side", [0, 1], ids=["source", "target"])
def test_a_pair_with_too_little_depth_is_a_status(depth, side):
    views = [look(), look()]
    views[side] = view(depth=depth)
    estimate = estimate_relative_pose(*views)
    assert (estimate.status, estimate.ok, estimate.T_target_source) == (Status.NO_MIXTURE, False, None)
    assert "the view has 0 usable depth pixels of 3072" in estimate.reason


def test_the_parts_the_bad_cases_are_made_of_are_good():
    assert len(reconstruct(view())) == 24 * 32
    assert len(reconstruct(look())) > 4000
    assert len(mixture()) == 60 and np.array_equal(Prior(np.eye(4), FREE).covariance, FREE)
    assert Config().replace({"lifting.stride": 4}).lifting.stride == 4


def test_readings_that_are_none_become_nan_and_depth_float32():
    depth = np.array(DEPTH, np.float64)
    depth[0, :4] = 0, np.inf, -np.inf, np.nan
    clean = view(depth=depth).depth
    assert clean.dtype == np.float32 and np.isnan(clean[0, :4]).all() and np.isfinite(clean).sum() == depth.size - 4


def test_errors_share_a_base_and_are_value_errors_where_a_value_is_wrong():
    for kind in (InputError, ConfigError):
        assert issubclass(kind, GarpsError) and issubclass(kind, ValueError)
    assert issubclass(ReconstructionError, GarpsError) and not issubclass(ReconstructionError, ValueError)


def test_a_nearly_rigid_pose_is_made_exactly_rigid():
    T = np.eye(4)
    T[:3, :3] += 2e-4 * np.arange(9).reshape(3, 3) / 8
    R = Prior(T, FREE).T_target_source[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
    assert np.abs(T[:3, :3] - R).max() < 3e-4


def test_settings_can_be_listed_and_put_back():
    config = Config.preset("demo_net")
    settings = config.settings()
    assert settings["start.min_inliers"] == 15 and Config().replace(settings) == config


def test_nothing_is_changed_in_place():
    mixture_, config = random_mixture(0, 60), Config()
    config.replace({"seed": 4})
    assert config.seed == 0
    for thing, name in ((mixture_, "means"), (config, "seed"), (view(), "rgb"), (PRIOR, "covariance")):
        with pytest.raises(AttributeError):
            setattr(thing, name, None)


def test_a_mixture_of_integers_is_taken_as_numbers():
    made = Mixture(np.ones((2, 3), int), [np.eye(3, dtype=int)] * 2, [1, 2], np.zeros((2, 3), int), [1, 2])
    assert made.means.dtype == made.weights.dtype == np.float64 and len(made) == 2
