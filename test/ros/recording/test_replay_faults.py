# SPDX-License-Identifier: Apache-2.0
"""garps-replay when something fails on the way: what was done is kept, what went wrong is said."""

import csv

import pytest
import recordings
from recordings import PERIOD, START, camera, frames, write

from garps_ros import replay
from garps_ros.recording.outputs import Outputs


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(replay, "Estimator", recordings.answering(recordings.estimate))


def run(bag, out, *options):
    return replay.main([str(bag), "--out", str(out), *options])


def statuses(out):
    with (out / "poses.csv").open(encoding="utf-8") as file:
        return [row["status"] for row in csv.DictReader(file)]


def test_a_malformed_image_of_one_camera_rejects_its_pair_only(tmp_path):
    messages = frames(["/left", "/right"], 2, "rosbags")
    broken = camera("/left", 3, "rosbags")
    broken[1][1].step = 5
    messages += [*broken, *camera("/right", 3, "rosbags"), *frames(["/left", "/right"], 4, "rosbags")[-6:]]
    assert run(write(tmp_path, "mcap", messages), tmp_path / "out") == 0
    assert statuses(tmp_path / "out") == ["converged", "converged", "malformed_message", "converged"]


def test_a_camera_without_one_readable_calibration_is_said(tmp_path, capfd):
    junk = ("/cam/camera_info", ("sensor_msgs/msg/CameraInfo", b"\0\1\0\0", START + PERIOD))
    messages = [junk, *(m for m in frames(["/cam"], 3, "rosbags") if "info" not in m[0])]
    assert run(write(tmp_path, "mcap", messages), tmp_path / "out") == 1
    shown = " ".join(capfd.readouterr().out.replace("│", " ").split())
    assert "messages refused 4" in shown and "message cannot be decoded as sensor_msgs/msg/CameraInfo" in shown


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (OSError(28, "No space left on device"), 2, "garps-replay: error: cannot go on: [Errno 28] No space left"),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_results_are_closed_when_writing_fails(tmp_path, monkeypatch, capfd, error, code, text):
    original = Outputs.write_row

    def failing(self, row):
        if self._rows == 2:
            raise error
        original(self, row)

    monkeypatch.setattr(Outputs, "write_row", failing)
    assert run(write(tmp_path, "mcap", frames(["/left", "/right"], 5, "rosbags")), tmp_path / "out") == code
    assert text in capfd.readouterr().err
    assert statuses(tmp_path / "out") == ["converged"] * 2
    assert (tmp_path / "out" / "poses" / "metadata.yaml").exists()


def test_a_programming_mistake_is_not_hidden_and_results_are_closed(tmp_path, monkeypatch):
    def broken(source, target, config, prior):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(replay, "Estimator", recordings.answering(broken))
    with pytest.raises(ZeroDivisionError):
        run(write(tmp_path, "mcap", frames(["/left", "/right"], 2, "rosbags")), tmp_path / "out")
    assert (tmp_path / "out" / "poses" / "metadata.yaml").exists()


def test_settings_reach_the_estimator(tmp_path, monkeypatch):
    seen = []

    def noting(source, target, config, prior):
        seen.append(config)
        return recordings.estimate(source, target)

    monkeypatch.setattr(replay, "Estimator", recordings.answering(noting))
    bag = write(tmp_path, "mcap", frames(["/cam"], 2, "rosbags"))
    changes = ("lifting.stride=4", "start.identity_fallback=false", "lifting.max_range_m=7", "device=cpu")
    options = [word for change in changes for word in ("--set", change)]
    assert run(bag, tmp_path / "out", "--preset", "monocular", *options) == 0
    assert (seen[0].lifting.stride, seen[0].start.identity_fallback, seen[0].lifting.max_range_m) == (4, False, 7.0)
    assert seen[0].lifting.noise_linear == 0.03  # of the preset
