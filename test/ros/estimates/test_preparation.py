# SPDX-License-Identifier: Apache-2.0
"""Cameras without depth topics: the network runs once per frame, live and offline; wrong settings are refused."""

import csv

import calm_network
import numpy as np
import pytest
from recordings import PERIOD, START, write
from ros_messages import camera_info, image
from torch.nn.modules.module import register_module_forward_pre_hook

from garps_core import Config, estimate_relative_pose
from garps_core.config.text import changed_config
from garps_core.errors import ConfigError, WeightsError
from garps_core.models import depth_anything
from garps_ros import replay
from garps_ros.estimates import preparation
from garps_ros.estimates.outcomes import Origin
from garps_ros.frames.assembly import DEPTH, IMAGE, Assembly
from garps_ros.frames.frame import CameraTopics, Frame, view_from_messages
from garps_ros.live.jobs import Job, JobRunner
from garps_ros.parameters.settings import NodeSettings
from msg_adapters import header_stamp_ns

pytest.importorskip("embreex")
from bench.rooms import make_pair

CHEAP = ["lifting.stride=4", "start.max_features=1000"]
CONFIG = changed_config(Config.preset("monocular"), [*calm_network.SETTINGS, *CHEAP])
ROOMS = make_pair(1, 1, width=320, height=240)
TOPICS = {side: CameraTopics(f"/{side}/image", f"/{side}/camera_info") for side in ("source", "target")}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return calm_network.install(tmp_path_factory.mktemp("weights"))


@pytest.fixture(autouse=True)
def installed(weights, monkeypatch):
    """The network is installed, and takes small pictures."""
    monkeypatch.setenv("GARPS_WEIGHTS", str(weights))
    monkeypatch.setattr(depth_anything, "SHORT_SIDE", 140)


@pytest.fixture
def passes():
    """Number of pictures that enter the network, pass by pass."""
    entered = []

    def note(module, given):
        if isinstance(module, depth_anything.DepthAnythingV2):
            entered.append(len(given[0]))

    hook = register_module_forward_pre_hook(note)
    yield entered
    hook.remove()


def messages(side, index, look):
    """Image and calibration of one look (0 or 1) of a room, as a camera without depth sends them."""
    rgb = (ROOMS.rgb0, ROOMS.rgb1)[look]
    head = {"stamp_ns": START + index * PERIOD, "frame_id": f"{side}_optical"}
    info = camera_info("rosbags", (rgb.shape[1], rgb.shape[0]), K=ROOMS.K0, D=[0] * 5, model="plumb_bob", **head)
    return image(rgb, "rgb8", "rosbags", **head), info


def frame(side, index, look):
    picture, info = messages(side, index, look)
    return Frame(TOPICS[side], header_stamp_ns(picture), picture, None, info)


def recording(folder, *shots):
    """A bag of (side, index, look)."""
    both = [(side, messages(side, index, look)) for side, index, look in shots]
    return write(
        folder,
        "mcap",
        [(f"/{side}/{name}", m) for side, pair in both for name, m in zip(("image", "camera_info"), pair, strict=True)],
    )


def replayed(bag, out, *options):
    """Rows of a replay with the network; code 0 is expected."""
    settings = [word for setting in [*calm_network.SETTINGS, *CHEAP] for word in ("--set", setting)]
    assert replay.main([str(bag), "--out", str(out), *settings, *options]) == 0
    with (out / "poses.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def followed():
    """Outcomes of a node that follows one camera: there and back again."""
    runner = JobRunner(lambda _: None)
    jobs = [
        Job((frame("source", i, look),), NodeSettings(pairing="keyframe"), CONFIG) for i, look in enumerate((0, 1, 0))
    ]
    return [outcome for job in jobs for outcome in runner(job).outcomes]


def translation(row):
    return [float(row[name]) for name in ("tx", "ty", "tz")]


def test_a_pair_takes_one_pass_also_for_its_clouds(passes):
    frames = frame("source", 1, 0), frame("target", 1, 1)
    result = JobRunner(lambda _: None)(Job(frames, NodeSettings(), CONFIG, clouds=True))
    (outcome,) = result.outcomes
    assert (result.trace, outcome.row.status) == ("", "converged") and passes == [2]
    assert all(len(cloud.points) > 1000 for cloud in result.clouds)
    offline = estimate_relative_pose(*(view_from_messages(f.image, f.info)[0] for f in frames), CONFIG)
    np.testing.assert_allclose(outcome.T, offline.T_target_source, atol=1e-6)


def test_a_camera_that_is_followed_takes_one_pass_per_frame_live_as_replayed(tmp_path, passes, capfd):
    origin, *attempts = followed()
    assert isinstance(origin, Origin) and len(attempts) == 2 and passes == [1, 1, 1]
    passes.clear()
    bag = recording(tmp_path, *[("cam", i, look) for i, look in enumerate((0, 1, 0))])
    rows = replayed(bag, tmp_path / "out")
    assert passes == [1, 1, 1]
    for attempt, row in zip(attempts, rows, strict=True):
        assert row["status"] == attempt.row.status == "converged"
        np.testing.assert_allclose(translation(row), attempt.row.T_target_source[:3, 3], atol=1e-6)
    told = capfd.readouterr().err
    assert f"loaded depth_anything_v2 (weights {calm_network.NAME}) in " in told
    assert "source: image /cam/image, info /cam/camera_info, depth from a network" in told


def test_two_plain_cameras_are_replayed(tmp_path, passes):
    bag = recording(tmp_path, *[(side, i, look) for i in (1, 2) for look, side in enumerate(("right", "left"))])
    rows = replayed(bag, tmp_path / "out", "--reconstruction", "depth_anything_v2")
    assert passes == [2, 2] and [row["status"] for row in rows] == ["converged"] * 2
    views = [view_from_messages(*messages(side, 1, look))[0] for look, side in enumerate(("right", "left"))]
    offline = estimate_relative_pose(*views, CONFIG)
    for row in rows:
        np.testing.assert_allclose(translation(row), offline.T_target_source[:3, 3], atol=1e-6)


WRONG = {
    "scene": ({"scene": "outdoor"}, WeightsError, "run `garps weights fetch depth-anything-v2-outdoor-small`"),
    "no such name": (
        {"depth_weights": "depth-anything-v2-indoor-smal"},
        WeightsError,
        f"did you mean '{calm_network.NAME}",
    ),
    "of another kind": (
        {"depth_weights": "dinov2-small"},
        WeightsError,
        "are weights of dinov2: expected some of depth",
    ),
    "no Flash3D": ({"method": "flash3d"}, WeightsError, "run `garps weights fetch flash3d`"),
    "no labels": ({"semantics": "linear"}, WeightsError, "dinov2_vits14_ade20k_linear_head.pth"),
}


@pytest.mark.parametrize(("changes", "kind", "text"), WRONG.values(), ids=WRONG)
def test_wrong_weights_are_found_before_the_first_pair(changes, kind, text):
    config = CONFIG.replace({f"reconstruction.{name}": value for name, value in changes.items()})
    with pytest.raises(kind) as caught:
        JobRunner(lambda _: None).prepare(config)
    assert text in str(caught.value)


def test_settings_for_a_sensor_do_not_go_with_a_network():
    with pytest.raises(ConfigError, match="expected the preset monocular"):
        preparation.check_method(Config().replace({"reconstruction.method": "flash3d"}))
    preparation.check_method(CONFIG)
    preparation.check_method(Config())


def test_a_sensor_needs_no_preparation_but_the_loops(monkeypatch):
    said = []
    monkeypatch.setattr(preparation, "LONG_S", -1.0)
    runner = JobRunner(said.append)
    runner.prepare(Config())
    assert runner.scale == "the depth topics, m" and runner.stage == ""
    assert len(said) == preparation.compiled.AVAILABLE and all("compiled" in text for text in said)


@pytest.mark.parametrize("preset", ["default", "monocular", "paper"])
def test_the_tiny_pair_is_aligned_whatever_the_settings(preset):
    odd = {"lifting.stride": 32, "lifting.min_range_m": 50.0, "start.method": "features"}
    preparation.warm_up(Config.preset(preset).replace(odd), print)


def test_an_image_is_complete_where_no_depth_is_wanted():
    refused = []
    assembly = Assembly([TOPICS["source"]], 0, lambda *told: refused.append(told), live=True)
    picture, info = messages("source", 1, 0)
    assert assembly.add(0, IMAGE, picture) == [], "it waits for its calibration"
    ((found,),) = assembly.add_info(0, info)
    assert found.depth is None and found.image is picture
    assert assembly.add(0, IMAGE, picture) == [] and "expected it to grow" in refused[0][1]
    assert assembly.add(0, IMAGE, messages("source", 2, 0)[0])[0][0].stamp_ns == START + 2 * PERIOD
    assert (assembly.unpaired, assembly.gaps_s()) == (0, {}) and assembly.newest_ns(0, DEPTH) > START
