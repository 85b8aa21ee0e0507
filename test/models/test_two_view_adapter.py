# SPDX-License-Identifier: Apache-2.0
"""Two-view adapters, installed as packages: the documented one, one that tells the truth, and those that go wrong."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from box_room import K_WORDS
from network_weights import shared, write_pair
from places import ROOT
from point_map_cases import Errors, point_maps, true_views
from two_view_fixtures import CALLS, FAULTS, RECORDED, installed_here, installed_package, write_maps

from bench.rooms import RoomPair, make_pair
from garps_core import Config, ConfigError, Estimator, PoseEstimate, Prior, Status, View, estimate_relative_pose
from garps_core.cli import command
from garps_core.errors import WeightsError
from garps_core.geometry import se3_exp, se3_inverse, se3_log, twist_from_ros
from garps_core.point_maps import PairMaps, PointMap
from garps_core.start.initialise import initialise
from garps_core.start.intrinsics import estimate_intrinsics
from garps_core.types import Mixture

DOCUMENT = ROOT / "docs" / "two_view_models.md"
ERRORS = Errors(noise=0.005, patches=0.005, scale=0.03)
LARGEST_NEES = 22.46
"""Bound of NEES of six numbers, 99.9 %."""
BY_PAIR = {"reconstruction.method": "two_view", "alignment.depth_errors": True}
Captured = pytest.CaptureFixture[str]


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def room() -> RoomPair:
    return make_pair(3, 2, 1.0, 320, 240, depth_noise="sensor")


@pytest.fixture(scope="module")
def adapters(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return installed_here(tmp_path_factory.mktemp("adapters"))


@pytest.fixture(scope="module")
def said(room: RoomPair) -> PairMaps:
    """Maps of the room with modest errors."""
    return point_maps(true_views(room), room.T_1_0, ERRORS, seed=1)


@pytest.fixture
def maps(room: RoomPair, said: PairMaps, tmp_path: Path) -> Path:
    """The file of the adapter that knows the room."""
    return write_maps(tmp_path / "room.npz", (room.rgb0, room.rgb1, said))


@pytest.fixture(autouse=True)
def installed(adapters: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(adapters))
    CALLS.clear()


def config(adapter: str = RECORDED, preset: str = "monocular", **more: object) -> Config:
    start = {"start.method": "adapter", "start.adapter": adapter}
    return Config.preset(preset).replace(start | {name.replace("__", "."): value for name, value in more.items()})


def recorded(maps: Path, preset: str = "monocular", **more: object) -> Config:
    return config(RECORDED, preset, start__weights=str(maps), **more)


def bare(room: RoomPair) -> tuple[View, View]:
    return View(room.rgb0, room.K0), View(room.rgb1, room.K1)


def sensed(room: RoomPair) -> tuple[View, View]:
    return View(room.rgb0, room.K0, room.depth0), View(room.rgb1, room.K1, room.depth1)


def off(found: Prior | PoseEstimate | None, T: np.ndarray) -> np.ndarray:
    """Twist (6,) from the truth."""
    assert found is not None and found.T_target_source is not None
    return se3_log(found.T_target_source @ se3_inverse(T))


def nees(found: Prior | PoseEstimate, T: np.ndarray) -> float:
    assert found.covariance is not None and np.isfinite(found.covariance).all()
    error = off(found, T)
    return float(error @ np.linalg.solve(twist_from_ros(found.covariance, found.T_target_source), error))


def test_pose_and_depth_of_two_pictures_from_one_answer(room: RoomPair, maps: Path) -> None:
    estimate = estimate_relative_pose(*bare(room), recorded(maps, reconstruction__method="two_view"))
    assert estimate.status is Status.CONVERGED, estimate.reason
    assert [RECORDED] == CALLS, "asked once, for the depth and for the start"
    assert estimate.initial is not None and estimate.initial.origin == RECORDED
    begun, ended = (np.linalg.norm(off(one, room.T_1_0)[:3]) for one in (estimate.initial, estimate))
    assert begun > 1e-4 and ended < max(begun, 0.01)
    assert np.degrees(np.linalg.norm(off(estimate, room.T_1_0)[3:])) < 1
    assert nees(estimate.initial, room.T_1_0) < LARGEST_NEES
    assert nees(estimate, room.T_1_0) < LARGEST_NEES
    assert estimate.estimated_fx_px == (None, None)
    assert estimate.seconds["depth"] > 0


def test_a_sensors_depth_refines_it(room: RoomPair, maps: Path) -> None:
    estimate = estimate_relative_pose(*sensed(room), recorded(maps, "default"))
    assert estimate.status is Status.CONVERGED, estimate.reason
    assert estimate.initial is not None and "metres as the network says" in estimate.initial.reason
    begun, ended = (np.linalg.norm(off(one, room.T_1_0)[:3]) for one in (estimate.initial, estimate))
    assert ended < 0.5 * begun
    assert ended < 0.01
    assert nees(estimate, room.T_1_0) < LARGEST_NEES
    assert "depth" not in estimate.seconds


@pytest.mark.parametrize(("method", "preset"), [("two_view", "monocular"), ("auto", "default")])
def test_estimated_intrinsics_widen_the_covariance(room: RoomPair, maps: Path, method: str, preset: str) -> None:
    views = bare(room) if method == "two_view" else sensed(room)
    settings = recorded(maps, preset, reconstruction__method=method)
    K = estimate_intrinsics(room.rgb0, room.rgb1, settings, shared())
    unknown = [View(view.rgb, own, view.depth, K_estimated=True) for view, own in zip(views, K, strict=True)]
    found, given = estimate_relative_pose(*unknown, settings), estimate_relative_pose(*views, settings)
    assert [RECORDED] * 3 == CALLS, "the intrinsics and each estimate ask once"
    assert found.status is given.status is Status.CONVERGED, found.reason
    assert found.estimated_fx_px == (K[0][0, 0], K[1][0, 0])
    np.testing.assert_allclose(found.estimated_fx_px, (room.K0[0, 0], room.K1[0, 0]), rtol=0.05)
    assert found.covariance is not None and given.covariance is not None
    assert np.linalg.det(found.covariance) > 100 * np.linalg.det(given.covariance)
    assert np.all(np.diag(found.covariance)[3:] > np.diag(given.covariance)[3:])
    assert nees(found, room.T_1_0) < LARGEST_NEES
    assert nees(found, room.T_1_0) > 0.05, "not wider than anybody could use"
    one = estimate_relative_pose(unknown[0], views[1], settings)
    assert one.estimated_fx_px == (K[0][0, 0], None)


def test_a_given_prior_is_put_together_with_the_network(room: RoomPair, maps: Path) -> None:
    near = Prior(se3_exp(np.array([0.02, -0.01, 0.01, 0, 0.005, 0])) @ room.T_1_0, np.diag([4e-4] * 3 + [1e-4] * 3))
    far = Prior(se3_exp(np.array([0.8, 0, 0, 0, 0.3, 0])) @ room.T_1_0, np.diag([1e-4] * 3 + [1e-4] * 3))
    settings = recorded(maps, reconstruction__method="two_view")
    (alone,), (together,) = (initialise(*bare(room), settings, prior, shared()) for prior in (None, near))
    assert together.origin == "given and recorded"
    assert np.all(np.diag(together.covariance) < np.diag(near.covariance))
    assert np.all(np.diag(together.covariance) < np.diag(alone.covariance))
    rivals = initialise(*bare(room), settings, far, shared())
    assert [one.origin for one in rivals] == [RECORDED, "given"]
    assert "contradicts the given prior" in rivals[0].reason and "contradicts the recorded" in rivals[1].reason
    for prior, origin in ((near, "given and recorded"), (far, RECORDED)):
        estimate = estimate_relative_pose(*bare(room), settings, prior)
        assert estimate.status is Status.CONVERGED, estimate.reason
        assert estimate.initial is not None and estimate.initial.origin == origin
        assert nees(estimate, room.T_1_0) < LARGEST_NEES
    assert [RECORDED] * 5 == CALLS, "every start by itself and every estimate asks once"


def test_what_is_unknown_or_unsure_is_left_out(room: RoomPair, tmp_path: Path) -> None:
    known = point_maps(true_views(room), room.T_1_0, ERRORS, seed=1)
    for one in (*known.source_first, *known.target_first):
        one.points[20:60, 30:90] = np.nan
        one.points[100:140, 150:200], one.confidence[100:140, 150:200] = 7.0, 1.5
    settings = recorded(write_maps(tmp_path / "gaps.npz", (room.rgb0, room.rgb1, known)))
    estimate = estimate_relative_pose(*bare(room), settings.replace({"reconstruction.method": "two_view"}))
    assert estimate.status is Status.CONVERGED, estimate.reason
    assert nees(estimate, room.T_1_0) < LARGEST_NEES
    blind = estimate_relative_pose(*sensed(room), settings.replace({"start.min_confidence": 20.0}))
    assert blind.status is Status.NO_INITIAL_POSE
    assert "0 of 3072 pixels are surer than 20" in blind.reason


@pytest.mark.parametrize("factor", [1e30, 1e-30, 0.0, -1.0])
def test_points_that_cannot_be_are_no_pose(room: RoomPair, said: PairMaps, tmp_path: Path, factor: float) -> None:
    orders = [
        tuple(PointMap(one.points * np.float32(factor), one.confidence) for one in order)
        for order in (said.source_first, said.target_first)
    ]
    wild = PairMaps(orders[0], orders[1], said.framings, True, "wild")
    settings = recorded(write_maps(tmp_path / "wild.npz", (room.rgb0, room.rgb1, wild)), "default")
    found = estimate_relative_pose(*sensed(room), settings)
    assert not found.ok and found.quality < 0.1, found
    found = estimate_relative_pose(*bare(room), settings.replace(BY_PAIR))
    assert found.status is Status.NO_MIXTURE, found.reason


def mixtures_in(room: RoomPair, settings: Config) -> tuple[PoseEstimate, tuple[Mixture, Mixture] | None]:
    return Estimator(settings).estimate_with_mixtures(*sensed(room))


@pytest.mark.parametrize(("name", "said"), [(name, said) for name, (_, said) in FAULTS.items()], ids=FAULTS)
def test_an_adapter_that_fails_is_a_status_with_its_name(room: RoomPair, name: str, said: str) -> None:
    for method, status in (("auto", Status.NO_INITIAL_POSE), ("two_view", Status.NO_MIXTURE)):
        found, mixtures = mixtures_in(room, config(name, reconstruction__method=method))
        assert (found.status, found.T_target_source, found.ok) == (status, None, False)
        assert f"the adapter '{name}' " in found.reason and said in found.reason
        assert (mixtures is None) == (status is Status.NO_MIXTURE)
    assert set(CALLS) == {name}


def test_pictures_that_an_adapter_does_not_know_are_a_status(room: RoomPair, maps: Path) -> None:
    views = sensed(room)
    found = estimate_relative_pose(views[1], views[0], recorded(maps, "default"))
    assert found.status is Status.NO_INITIAL_POSE
    assert "the adapter 'recorded' failed (LookupError: two pictures it has never seen)" in found.reason


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("", ConfigError, r"start\.adapter is (''|empty): expected the name of an installed adapter"),
        ("os", ConfigError, r"start\.adapter is 'os': .*one of doubles, forgetful, .*docs/two_view_models\.md"),
        ("two_view_fixtures:recorded", ConfigError, "expected the name of an installed adapter"),
        ("not_there", ConfigError, r"'not_there' \(no_such_package\.two_view:load\) cannot be loaded: ModuleNotFound"),
        ("misspelt", ConfigError, r"'misspelt' \(two_view_fixtures:laod\) cannot be loaded: AttributeError"),
        ("without_memory", ConfigError, r"'without_memory' .* cannot be loaded: RuntimeError: CUDA error: out of mem"),
        (RECORDED, ConfigError, r"'recorded' .* cannot be loaded: FileNotFoundError: .*nothing\.npz"),
        ("without_weights", WeightsError, r"no weights in nothing\.npz: expected my\.pth"),
    ],
)
def test_an_adapter_that_cannot_be_had_is_a_mistake_of_the_settings(
    room: RoomPair, name: str, error: type[Exception], message: str
) -> None:
    for method in ("auto", "two_view"):
        with pytest.raises(error, match=message):
            mixtures_in(room, config(name, start__weights="nothing.npz", reconstruction__method=method))
    assert CALLS == []


def written(room: RoomPair, folder: Path) -> list[str]:
    paths = [str(folder / f"{name}.png") for name in "ab"]
    for path, rgb in zip(paths, (room.rgb0, room.rgb1), strict=True):
        cv2.imwrite(path, rgb[:, :, ::-1])
    return paths


@pytest.mark.parametrize("calibrated", [True, False])
def test_two_picture_files_are_all_it_takes(
    room: RoomPair, maps: Path, tmp_path: Path, calibrated: bool, capsys: Captured
) -> None:
    """The preset mast3r with an adapter: intrinsics, depth and start come from one answer."""
    own = ["--start", "adapter", "--set", f"start.adapter={RECORDED}", "--set", f"start.weights={maps}"]
    words = ["align", *written(room, tmp_path), "--preset", "mast3r", *own]
    numbers = [[str(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))] for K in (room.K0, room.K1)]
    given = ["--K", *numbers[0], "--K-target", *numbers[1]] if calibrated else []
    assert command.main([*words, *given, "--json"]) == 0
    out = json.loads(capsys.readouterr().out)
    assert out["initial"]["origin"] == RECORDED and [RECORDED] == CALLS
    assert np.abs(off(Prior(np.array(out["T_target_source"]), np.eye(6)), room.T_1_0)).max() < 0.05
    told = out["estimated_fx_px"]
    assert told == [None, None] if calibrated else told == pytest.approx([room.K0[0, 0], room.K1[0, 0]], rel=0.05)
    assert command.main([*words, *given]) == 0
    text = capsys.readouterr().out
    assert ("intrinsics   estimated: focal lengths 2" in text) == (not calibrated)
    assert "start        recorded (" in text


def test_one_camera_of_two_cannot_be_unknown(room: RoomPair, maps: Path, tmp_path: Path, capsys: Captured) -> None:
    own = ["--start", "adapter", "--set", f"start.adapter={RECORDED}", "--set", f"start.weights={maps}"]
    assert command.main(["align", *written(room, tmp_path), *own, "--K-target", "200", "200", "160", "120"]) == 2
    assert "--K-target is given without --K" in capsys.readouterr().err


def test_intrinsics_that_the_network_cannot_tell_are_no_pose(tmp_path: Path, capsys: Captured) -> None:
    """Not a mistake in what was typed: code 1."""
    files = write_pair(tmp_path)
    words = ["align", files["a"], files["b"], "--start", "adapter", "--json", "--preset", "mast3r"]
    for name, said in (("raising", "the battery is empty"), ("misshapen", "expected points hxwx3")):
        assert command.main([*words, "--set", f"start.adapter={name}"]) == 1
        out = json.loads(capsys.readouterr().out)
        assert (out["status"], out["T_target_source"], out["quality"]) == ("no_initial_pose", None, 0)
        assert out["reason"].startswith("no --K, and none by adapter: the adapter ") and said in out["reason"]


NETWORK = '''
"""A small network of somebody else's: a wall two metres ahead, bent by what the pictures show."""
import torch
from torch import nn


class Network(nn.Module):
    def __init__(self):
        super().__init__()
        self.look = nn.Conv2d(3, 4, 5, padding=2)

    def forward(self, pictures):
        seen = self.look(pictures).permute(0, 2, 3, 1)
        return seen[..., :3] + torch.tensor([0.0, 0.0, 2.0]), 1 + seen[..., 3].exp()


def load_network(weights):
    network = Network()
    network.load_state_dict(torch.load(weights, weights_only=True))
    return network.eval()
'''


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The package of the document, word by word, installed; its weights are my.pth."""
    (code,) = (block.split("\n```")[0] for block in DOCUMENT.read_text(encoding="utf-8").split("```python\n")[1:])
    assert max(map(len, code.split("\n"))) <= 120
    package = tmp_path / "my_robot"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "network.py").write_text(NETWORK, encoding="utf-8")
    (package / "two_view.py").write_text(code + "\n", encoding="utf-8")
    assert 'my_model = "my_robot.two_view:load"' in DOCUMENT.read_text(encoding="utf-8")
    installed_package(tmp_path, "my_robot", {"my_model": "my_robot.two_view:load"})
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for name in ("my_robot", "my_robot.network", "my_robot.two_view"):
        sys.modules.pop(name, None)


def test_the_documented_adapter_runs_as_it_stands(
    robot: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    from my_robot.network import Network

    torch.manual_seed(2)
    torch.save(Network().state_dict(), robot / "my.pth")
    files = write_pair(robot)
    words = ["align", files["a"], files["b"], *K_WORDS, "--start", "adapter", "--set", "start.adapter=my_model"]
    words += ["--set", f"start.weights={robot / 'my.pth'}", "--set", "start.min_confidence=1.01", "--json"]
    depths = ["--depth-source", files["a_mm"], "--depth-target", files["b_mm"]]
    for more in (depths, ["--preset", "mast3r"]):
        assert command.main([*words, *more]) == 1, "it knows nothing of rooms"
        out = json.loads(capsys.readouterr().out)
        assert out["status"] == "no_initial_pose" and out["T_target_source"] is None
        assert out["reason"].startswith("my_model: source first: ")
        assert "of 12288 trusted pixels fit one pose" in out["reason"]


def test_the_documented_adapter_says_what_its_network_sees(robot: Path) -> None:
    """The adapter gives both orders, with the framing of the whole picture."""
    from my_robot.network import Network
    from my_robot.two_view import load

    torch.manual_seed(2)
    torch.save(Network().state_dict(), robot / "my.pth")
    one, other = (np.random.default_rng(seed).integers(0, 256, (60, 80, 3), np.uint8) for seed in (0, 1))
    said = load(str(robot / "my.pth"), "cpu")(one, other)
    assert [framing.size for framing in said.framings] == [(384, 512)] * 2
    np.testing.assert_allclose(
        said.framings[0].to_image(np.array([[-0.5, -0.5], [511.5, 383.5]])), [[-0.5] * 2, [79.5, 59.5]]
    )
    np.testing.assert_array_equal(said.source_first[1].points, said.target_first[0].points)
    assert np.abs(said.source_first[0].points - said.target_first[0].points).max() > 0.1
