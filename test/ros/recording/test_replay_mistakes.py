# SPDX-License-Identifier: Apache-2.0
"""garps-replay: what a user can get wrong is one line on stderr, exit code 2, and leaves no folder behind."""

import re

import pytest
from recordings import frames, write

from garps_ros import replay


def single_camera(folder):
    return write(folder, "mcap", frames(["/cam"], 2, "rosbags"))


def without(kind):
    return lambda folder: write(
        folder, "mcap", [m for m in frames(["/cam"], 2, "rosbags") if kind not in m[0].rpartition("/cam")[2]]
    )


def garbage(name):
    def make(folder):
        (folder / name).write_bytes(b"this is no recording " * 100)
        return folder / name

    return make


def cut_at_once(folder):
    bag = single_camera(folder)
    file = bag / "walk.mcap"
    file.write_bytes(file.read_bytes()[:100])
    return file


def cut_metadata(folder):
    bag = write(folder, "sqlite3", frames(["/cam"], 2, "rosbags"))
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    return bag


def no_metadata(folder):
    bag = write(folder, "sqlite3", frames(["/cam"], 2, "rosbags"))
    (bag / "metadata.yaml").unlink()
    return bag


def three_cameras(folder):
    return write(folder, "mcap", frames(["/a", "/b", "/c"], 1, "rosbags", offsets=(0, 0, 0)))


MISTAKES = {
    "missing": (lambda folder: folder / "nowhere", [], "nowhere does not exist: expected a rosbag2 folder"),
    "corrupt ros1": (garbage("a.bag"), [], "cannot be read as a recording"),
    "corrupt mcap": (garbage("a.mcap"), [], "cannot be read as a recording"),
    "corrupt sqlite": (garbage("a.db3"), [], "cannot be read as a recording"),
    "mcap cut at once": (cut_at_once, [], "cannot be read as a recording|holds no messages"),
    "another file": (garbage("a.txt"), [], "cannot be read as a recording"),
    "empty file": (lambda folder: (folder / "a.bag").touch() or folder / "a.bag", [], "cannot be read"),
    "corrupt metadata": (cut_metadata, [], "cannot be read as a recording"),
    "no metadata": (no_metadata, [], "without metadata.yaml give the .mcap or .db3 file inside"),
    "an empty folder": (lambda folder: folder, [], "cannot be read as a recording"),
    "no messages": (lambda folder: write(folder, "mcap", []), [], "holds no messages"),
    "no messages ros1": (lambda folder: write(folder, "ros1", []), [], "holds no messages"),
    "topic missing": (single_camera, ["--source-image", "/x"], "topic /x is not in the recording: .*/cam/image_raw"),
    "info missing": (single_camera, ["--source-info", "/x"], "topic /x is not in the recording"),
    "image is info": (
        single_camera,
        ["--source-image", "/cam/camera_info"],
        "topic /cam/camera_info is sensor_msgs/msg/CameraInfo: expected sensor_msgs/msg/Image or",
    ),
    "info is image": (single_camera, ["--source-info", "/cam/image_raw"], "expected sensor_msgs/msg/CameraInfo"),
    "no images": (without("image_raw"), [], r"found 0 \(none\): give --target-image; topics: /cam/camera_info"),
    "no depth": (without("depth"), [], "no depth found for /cam/image_raw: expected depth of every camera"),
    "a way without": (without("depth"), [], "--reconstruction depth_anything_v2, whose weights `garps weights fetch d"),
    "both depths": (
        single_camera,
        ["--reconstruction", "flash3d", "--source-depth", "/cam/depth/image_raw"],
        "depth topic /cam/depth/image_raw is given, and --reconstruction names a network",
    ),
    "no weights": (single_camera, ["--set", "reconstruction.method=flash3d"], "run `garps weights fetch depth-an"),
    "splats": (single_camera, ["--reconstruction", "ply"], "reconstruction.method is ply, mixtures from files"),
    "depth of a sensor": (
        single_camera,
        ["--reconstruction", "depth_anything_v2", "--preset", "sensor"],
        "expected the preset monocular",
    ),
    "no info": (without("info"), [], "no camera_info found for /cam/image_raw: give --source-info"),
    "one camera as two": (single_camera, ["--pairing", "cameras"], r"found 1 \(/cam/image_raw\)"),
    "three cameras": (three_cameras, [], r"found 3 \(/a/image_raw; /b/image_raw; /c/image_raw\)"),
    "a keyframe of two": (
        single_camera,
        ["--pairing", "keyframe", "--target-image", "/cam/image_raw"],
        "--pairing keyframe follows one camera",
    ),
    "a camera with itself": (
        single_camera,
        [
            *("--source-image", "/cam/image_raw", "--source-depth", "/cam/depth/image_raw"),
            *("--target-image", "/cam/image_raw", "--target-depth", "/cam/depth/image_raw"),
        ],
        "source and target are both /cam/image_raw",
    ),
    "preset": (single_camera, ["--preset", "best"], "preset 'best' does not exist: expected one of default"),
    "setting": (single_camera, ["--set", "lifting.stripe=2"], "did you mean 'lifting.stride'"),
    "setting without value": (single_camera, ["--set", "lifting.stride"], "has no '='"),
    "setting of another type": (single_camera, ["--set", "lifting.stride=two"], "'two': expected an integer"),
    "setting out of range": (single_camera, ["--set", "lifting.stride=99"], "expected between 1 and 32"),
    "setting of several numbers": (single_camera, ["--set", "alignment.ladder=1"], "cannot be set as text"),
    "setting yes": (single_camera, ["--set", "start.identity_fallback=yes"], "expected true or false"),
    "pairing": (single_camera, ["--pairing", "stereo"], "--pairing is 'stereo': expected one of auto, cameras"),
    "rectified": (single_camera, ["--rectified", "yes"], "--rectified is 'yes': expected one of auto, rectified, raw"),
    "slop": (single_camera, ["--slop", "-1"], "--slop"),
    "option": (single_camera, ["--sauce", "1"], "--sauce"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_one_line_and_code_2(tmp_path, capfd, name, monkeypatch):
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path / "none"))
    make, options, expected = MISTAKES[name]
    bag = make(tmp_path)
    assert replay.main([str(bag), "--out", str(tmp_path / "out"), *options]) == 2
    err = capfd.readouterr().err
    assert err.startswith("garps-replay: error: ") and err.count("\n") == 1
    assert re.search(expected, err), err
    assert not (tmp_path / "out").exists()
