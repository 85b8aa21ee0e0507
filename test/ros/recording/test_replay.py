# SPDX-License-Identifier: Apache-2.0
"""garps-replay: recordings of three kinds in, trajectory, table and bag out; every mistake is one line."""

import csv
import functools
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import recordings
from places import ROOT
from recordings import PERIOD, START, STORAGES, camera, frames, library_of, write
from ros_messages import camera_info, compressed, header, image
from rosbags.highlevel import AnyReader

from garps_core.errors import GarpsError, InputError, ReconstructionError
from garps_ros import replay
from msg_adapters import pose_from_message, stamp_to_ns


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(replay, "Estimator", recordings.answering(recordings.estimate))


def run(bag, out, *options):
    return replay.main([str(bag), "--out", str(out), *map(str, options)])


def rows(out):
    with (out / "poses.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def trajectory(out, name="trajectory.tum"):
    return np.loadtxt(out / name, ndmin=2)


def published(out):
    """(topic, time of recording, message) of the bag that was written."""
    with AnyReader([out / "poses"]) as reader:
        return [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]


@pytest.mark.parametrize("storage", STORAGES)
def test_one_camera_is_followed_in_the_frame_of_its_first_image(tmp_path, capfd, storage):
    bag = write(tmp_path, storage, frames(["/cam"], 8, library_of(storage)))
    out = tmp_path / "out"
    assert run(bag, out) == 0
    path = trajectory(out)
    np.testing.assert_allclose(path[:, 0], (START + np.arange(1, 9) * PERIOD) / 1e9, rtol=1e-15)
    np.testing.assert_allclose(path[:, 1:], [[0.1 * i, 0, 0, 0, 0, 0, 1] for i in range(8)], atol=1e-9)
    assert (out / "trajectory.tum").read_text().startswith("# pose of camera cam_optical in cam_optical_start;")
    assert [row["status"] for row in rows(out)] == ["converged"] * 7
    shown = capfd.readouterr()
    assert "source: image /cam/image_raw, info /cam/camera_info, depth /cam/depth/image_raw" in shown.err
    assert "raw image (topic /cam/image_raw): K with plumb_bob of zeros" in shown.err
    assert "pairs in" in shown.out and "latency median / p95" in shown.out


def test_keyframes_are_taken_beyond_the_limit_and_covariances_add_up(tmp_path):
    bag = write(tmp_path, "mcap", frames(["/cam"], 8, "rosbags"))
    assert run(bag, tmp_path / "out", "--keyframe-motion", "0.25") == 0
    found = rows(tmp_path / "out")
    keyframes = [(int(row["target_stamp_ns"]) - START) // PERIOD for row in found]
    assert keyframes == [1, 1, 1, 4, 4, 4, 7]  # 0.3 m is beyond 0.25 m
    np.testing.assert_allclose([float(row["tx"]) for row in found], [0.1, 0.2, 0.3, 0.1, 0.2, 0.3, 0.1], atol=1e-9)
    variances = [float(m.pose.covariance[0]) for topic, _, m in published(tmp_path / "out") if "odom" in topic]
    np.testing.assert_allclose(variances, np.array([1, 1, 1, 2, 2, 2, 3]) * 1e-4)


@pytest.mark.parametrize("storage", STORAGES)
def test_two_cameras_give_the_pose_of_source_in_target(tmp_path, capfd, storage):
    bag = write(tmp_path, storage, frames(["/left", "/right"], 5, library_of(storage), offsets=(0, 4_000_000)))
    out = tmp_path / "out"
    assert run(bag, out) == 0
    np.testing.assert_allclose(trajectory(out)[:, 1:], [[0.25, 0, 0, 0, 0, 0, 1]] * 5, atol=1e-9)
    found = rows(out)
    assert [int(row["source_stamp_ns"]) - int(row["target_stamp_ns"]) for row in found] == [4_000_000] * 5
    assert {(row["source_frame"], row["target_frame"]) for row in found} == {("right_optical", "left_optical")}
    assert "source: image /right/image_raw" in capfd.readouterr().err
    assert len(published(out)) == 10
    for topic, recorded, message in published(out):
        stamp = stamp_to_ns(message.header.stamp)
        assert recorded == stamp and (stamp - START) % PERIOD == 4_000_000  # the source image's time
        assert message.header.frame_id == "left_optical"
        T, covariance = pose_from_message(message)
        np.testing.assert_allclose(T, recordings.moved(0.25), atol=1e-12)
        if topic == "/garps/odometry":
            assert message.child_frame_id == "right_optical"
            np.testing.assert_allclose(covariance, recordings.COVARIANCE)


def test_cameras_may_be_swapped_and_pairs_limited(tmp_path):
    bag = write(tmp_path, "mcap", frames(["/left", "/right"], 5, "rosbags"))
    options = ("--source-image", "/left/image_raw", "--target-image", "/right/image_raw", "--limit", 2)
    assert run(bag, tmp_path / "out", *options) == 0
    assert [row["source_frame"] for row in rows(tmp_path / "out")] == ["left_optical"] * 2


def test_cameras_beyond_the_slop_are_not_paired(tmp_path):
    bag = write(tmp_path, "mcap", frames(["/left", "/right"], 5, "rosbags", offsets=(0, 30_000_000)))
    assert run(bag, tmp_path / "out") == 1
    assert rows(tmp_path / "out") == [] and published(tmp_path / "out") == []
    assert run(bag, tmp_path / "wide", "--slop", 0.04) == 0
    assert len(rows(tmp_path / "wide")) == 5


def test_two_cameras_of_one_frame_name_are_told_apart_by_topic(tmp_path):
    both = [m for prefix in ("/left", "/right") for m in camera(prefix, 1, "rosbags", frame_id="camera")]
    bag = write(tmp_path, "mcap", both)
    run(bag, tmp_path / "out")
    row = rows(tmp_path / "out")[0]
    assert (row["source_frame"], row["target_frame"]) == ("right_image_raw", "left_image_raw")


def test_the_same_recording_gives_the_same_bytes(tmp_path):
    bag = write(tmp_path, "mcap", frames(["/cam"], 6, "rosbags"))
    for name in ("a", "b"):
        assert run(bag, tmp_path / name) == 0
        time.sleep(1.1)  # were the time of day anywhere, it would differ by now
    files = [path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file()]
    expected = {"poses.csv", "poses/metadata.yaml", "poses/poses.mcap", "trajectory.tum"}
    assert {path.as_posix() for path in files} == expected
    for path in files:
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes(), path


def test_the_bag_is_one_that_jazzy_plays(tmp_path):
    run(write(tmp_path, "mcap", frames(["/cam"], 3, "rosbags")), tmp_path / "out")
    metadata = (tmp_path / "out" / "poses" / "metadata.yaml").read_text()
    assert "version: 9" in metadata and "storage_identifier: mcap" in metadata


def test_rejected_estimates_are_listed_but_not_published(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(replay, "Estimator", recordings.answering(functools.partial(recordings.estimate, bad={3, 5})))
    bag = write(tmp_path, "mcap", frames(["/left", "/right"], 6, "rosbags"))
    out = tmp_path / "out"
    assert run(bag, out) == 0
    assert [row["status"] for row in rows(out)].count("low_overlap") == 2
    bad = [row for row in rows(out) if row["status"] == "low_overlap"]
    assert {(row["reason"], row["tx"], row["c00"]) for row in bad} == {("made to fail", "", "")}
    assert len(trajectory(out)) == 4 and len(published(out)) == 8
    assert "rejected: low_overlap" in capfd.readouterr().out


def test_a_pose_that_did_not_converge_is_in_the_table_only(tmp_path, monkeypatch):
    def unsure(source, target, config, prior):
        return recordings.PoseEstimate(
            recordings.Status.DEGENERATE, "a wall", recordings.moved(0.1), recordings.COVARIANCE, overlap=0.5
        )

    monkeypatch.setattr(replay, "Estimator", recordings.answering(unsure))
    out = tmp_path / "out"
    assert run(write(tmp_path, "mcap", frames(["/left", "/right"], 2, "rosbags")), out) == 1
    assert [(row["status"], float(row["tx"]), float(row["c00"])) for row in rows(out)] == [
        ("degenerate", 0.1, 1e-4)
    ] * 2
    assert published(out) == [] and len((out / "trajectory.tum").read_text().splitlines()) == 2


def test_a_covariance_that_lies_is_not_published(tmp_path, monkeypatch):
    lying = functools.partial(recordings.estimate, covariance=np.zeros((6, 6)))
    monkeypatch.setattr(replay, "Estimator", recordings.answering(lying))
    out = tmp_path / "out"
    assert run(write(tmp_path, "mcap", frames(["/left", "/right"], 2, "rosbags")), out) == 1
    assert {row["status"] for row in rows(out)} == {"not_publishable"}
    assert "zeros do not mean unknown" in rows(out)[0]["reason"]
    assert published(out) == []


def test_a_bad_frame_does_not_break_the_path_and_being_lost_starts_a_new_one(tmp_path, monkeypatch):
    estimate = functools.partial(recordings.estimate, bad={3, *range(6, 11)})
    monkeypatch.setattr(replay, "Estimator", recordings.answering(estimate))
    out = tmp_path / "out"
    assert run(write(tmp_path, "mcap", frames(["/cam"], 13, "rosbags")), out) == 0
    np.testing.assert_allclose(trajectory(out)[:, 1], [0, 0.1, 0.3, 0.4], atol=1e-9)  # 3 is missing, 4 is right
    np.testing.assert_allclose(trajectory(out, "trajectory_2.tum")[:, 1], [0, 0.1, 0.2], atol=1e-9)
    names = {m.header.frame_id for _, _, m in published(out)}
    assert names == {"cam_optical_start", "cam_optical_start_2"}
    assert {row["segment"] for row in rows(out)} == {"1", "2"}


CORE_ERRORS = {
    "invalid_input": InputError("made up"),
    "no_reconstruction": ReconstructionError("made up"),
    "core_error": GarpsError("made up"),
}


@pytest.mark.parametrize("status", CORE_ERRORS)
def test_errors_of_the_core_are_rows(tmp_path, monkeypatch, status):
    def failing(source, target, config, prior):
        if recordings.index_of(source) == 2:
            raise CORE_ERRORS[status]
        return recordings.estimate(source, target)

    monkeypatch.setattr(replay, "Estimator", recordings.answering(failing))
    out = tmp_path / "out"
    assert run(write(tmp_path, "mcap", frames(["/cam"], 4, "rosbags")), out) == 0
    assert [row["status"] for row in rows(out)] == [status, "converged", "converged"]
    assert rows(out)[0]["reason"] == "made up"


def spoiled(index, **fields):
    """Frame `index` of the camera with a malformed colour image."""
    messages = camera("/cam", index, "rosbags")
    for name, value in fields.items():
        setattr(messages[1][1], name, value)
    return messages


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_malformed_messages_are_counted_and_passed_over(tmp_path, capfd, storage):
    when = START + 5 * PERIOD
    messages = [
        *frames(["/cam"], 2, "rosbags"),
        *spoiled(3, step=7),
        *spoiled(4, encoding="yuv422"),
        ("/cam/image_raw", ("sensor_msgs/msg/Image", b"\0\1\0\0junk", when)),
        *spoiled(5, header=header("rosbags", 0)),
        *camera("/cam", 2, "rosbags")[1:2],  # the clock jumps back
        *camera("/cam", 6, "rosbags", calibrated=False),
        *camera("/cam", 7, "rosbags"),
    ]
    out = tmp_path / "out"
    assert run(write(tmp_path, storage, messages), out) == 0
    assert [row["status"] for row in rows(out)] == ["converged", *["malformed_message"] * 3, "converged"]
    reasons = [row["reason"] for row in rows(out)]
    assert reasons[1].startswith("step is 7") and reasons[2].startswith("encoding is 'yuv422'")
    assert reasons[3].startswith("k[0] is 0")
    shown = " ".join(capfd.readouterr().out.split())
    assert "rejected: malformed_message │ 3" in shown and "messages refused │ 3" in shown
    assert "message cannot be decoded" in shown


PAGE, TABLE = 4096, {2, 5, 10, 13}  # of sqlite: size of a page, first byte of those that are no message contents


def storage_file(bag):
    return bag if bag.is_file() else next(path for path in bag.iterdir() if path.suffix != ".yaml")


@pytest.mark.parametrize("storage", STORAGES)
def test_damage_in_the_middle_keeps_what_was_read(tmp_path, capfd, storage):
    bag = write(tmp_path, storage, frames(["/cam"], 150, library_of(storage)))
    data = bytearray(storage_file(bag).read_bytes())
    middle, length = len(data) // 2 // PAGE * PAGE, 200_000
    if storage == "sqlite3":  # two pages of one message; a damaged table page would be noticed on opening
        length = 2 * PAGE
        middle = next(at for at in range(middle, len(data), PAGE) if not TABLE & {data[at], data[at + PAGE]})
    data[middle : middle + length] = b"\xaa" * length
    storage_file(bag).write_bytes(data)
    assert run(bag, tmp_path / "out") == 0
    assert "recording breaks off" in capfd.readouterr().out
    path = trajectory(tmp_path / "out")
    assert 20 < len(path) < 140
    np.testing.assert_allclose(path[:, 1], np.arange(len(path)) * 0.1, atol=1e-9)
    assert len(published(tmp_path / "out")) == 2 * (len(path) - 1)


@pytest.mark.parametrize("metadata", [True, False])
@pytest.mark.parametrize("share", [0.7, 0.995, 1 - 1e-6])
def test_an_mcap_file_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path, capfd, metadata, share):
    """A recorder that loses power leaves no index, no footer and no metadata.yaml."""
    bag = write(tmp_path, "mcap", frames(["/cam"], 150, "rosbags"))
    whole = storage_file(bag).read_bytes()
    storage_file(bag).write_bytes(whole[: int(len(whole) * share)])
    if not metadata:
        (bag / "metadata.yaml").unlink()
    assert run(bag, tmp_path / "out") == 0
    assert "recording breaks off │ the end of the file is missing" in " ".join(capfd.readouterr().out.split())
    assert len(trajectory(tmp_path / "out")) >= 60
    assert run(storage_file(bag), tmp_path / "again") == 0
    assert (tmp_path / "again" / "poses.csv").read_bytes() == (tmp_path / "out" / "poses.csv").read_bytes()


def test_a_whole_mcap_file_needs_no_metadata(tmp_path, capfd):
    bag = write(tmp_path, "mcap", frames(["/cam"], 3, "rosbags"))
    (bag / "metadata.yaml").unlink()
    assert run(bag, tmp_path / "out") == 0 and len(trajectory(tmp_path / "out")) == 3
    assert "breaks off" not in capfd.readouterr().out


@pytest.mark.parametrize("storage", ["sqlite3", "ros1"])
def test_files_that_need_their_end_are_refused_with_advice(tmp_path, capfd, storage):
    bag = write(tmp_path, storage, frames(["/cam"], 12, library_of(storage)))
    whole = storage_file(bag).read_bytes()
    storage_file(bag).write_bytes(whole[: len(whole) * 2 // 3])
    assert run(bag, tmp_path / "out") == 2
    shown = capfd.readouterr().err
    assert shown.count("\n") == 1 and "cannot be read as a recording" in shown and "reindex" in shown
    assert not (tmp_path / "out").exists()


def test_results_are_not_overwritten_by_accident(tmp_path, capfd):
    bag, out = write(tmp_path, "mcap", frames(["/cam"], 2, "rosbags")), tmp_path / "out"
    assert run(bag, out) == 0
    (out / "notes.txt").write_text("mine")
    before = (out / "poses.csv").read_bytes()
    assert run(bag, out) == 2
    assert "exists and is not empty" in capfd.readouterr().err
    assert run(bag, out, "--overwrite") == 0
    assert (out / "poses.csv").read_bytes() == before and (out / "notes.txt").read_text() == "mine"
    (out / "poses" / "precious.mcap").write_text("mine")
    assert run(bag, out, "--overwrite") == 2
    assert (out / "poses" / "precious.mcap").read_text() == "mine"
    (tmp_path / "file").write_text("mine")
    assert run(bag, tmp_path / "file") == 2 and run(bag, tmp_path / "file", "--overwrite") == 2
    assert (tmp_path / "file").read_text() == "mine"


def test_help_shows_examples_and_nothing_is_an_error(capfd):
    assert replay.main(["--help"]) == 0
    shown = capfd.readouterr().out
    assert "Examples:" in shown and "garps-replay walk/ --out walk_poses" in shown and "Exit code" in shown
    assert replay.main([]) == 2


SLOW = """
import sys, time
sys.path.insert(0, sys.argv.pop(1))
import recordings
from garps_ros import replay
def slow(source, target, config, prior):
    print("estimating", flush=True)
    time.sleep(0.3)
    return recordings.estimate(source, target)
replay.Estimator = recordings.answering(slow)
sys.exit(replay.main(sys.argv[1:]))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_replay_leaves_valid_results(tmp_path, number):
    bag, out = write(tmp_path, "mcap", frames(["/cam"], 60, "rosbags")), tmp_path / "out"
    command = [sys.executable, "-c", SLOW, str(ROOT / "test" / "tools"), str(bag), "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment
    ) as process:
        for _ in range(3):
            assert process.stdout.readline() == "estimating\n"
        process.send_signal(number)
        output, errors = process.communicate(timeout=30)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors and "poses used" in output
    done = len(rows(out))
    assert 2 <= done < 10
    assert len(trajectory(out)) == done + 1 and len(published(out)) == 2 * done


def test_replay_needs_no_ros():
    code = "import garps_ros.replay, sys; sys.exit('rclpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=60).returncode == 0


def test_compressed_topics_are_read_and_rectified_ones_use_p(tmp_path, capfd):
    import cv2

    pixels = recordings.picture(1)
    png = cv2.imencode(".png", pixels[..., ::-1])[1].tobytes()
    depth = cv2.imencode(".png", np.full((48, 64), 2000, np.uint16))[1].tobytes()
    P = np.array([[40.0, 0, 32, 0], [0, 40, 24, 0], [0, 0, 1, 0]])
    messages = []
    for index in range(2):
        head = {"stamp_ns": START + index * PERIOD, "frame_id": "cam"}
        messages += [
            ("/cam/camera_info", camera_info("rosbags", P=P, **head)),
            ("/cam/image_rect/compressed", compressed(png, "rgb8; png compressed bgr8", "rosbags", **head)),
            (
                "/cam/depth/compressedDepth",
                compressed(bytes(12) + depth, "16UC1; compressedDepth png", "rosbags", **head),
            ),
            ("/cam/extra", image(pixels, "rgb8", "rosbags", **head)),
        ]
    options = ("--source-image", "/cam/image_rect/compressed")
    assert run(write(tmp_path, "mcap", messages), tmp_path / "out", *options) == 0
    assert "rectified image (topic /cam/image_rect/compressed): P" in capfd.readouterr().err
