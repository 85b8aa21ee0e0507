# SPDX-License-Identifier: Apache-2.0
"""Readers of RealEstate10K and of pair lists: poses, pixels, categories, sampling, scale, and what they refuse."""

from __future__ import annotations

import json
from collections import Counter

import cv2
import numpy as np
import pytest
from clips import HEIGHT, WIDTH, motion, track_line, write_frames, write_sparse, write_track
from places import DATA

from bench.pairs.pair import rng_of
from bench.pairs.readers import READERS, MissingFiles, load, pair_list, pairs_json, realestate10k, sfm_scale
from bench.pairs.readers.dataset_files import arrays, category_of, chosen, frame_gaps, inside, rows, text_of
from garps_core.geometry import project, transform


@pytest.fixture
def clips(tmp_path):
    """Six small and six large clips, and one that is too short."""
    for k in range(6):
        write_track(tmp_path, f"s{k}", motion(5, (0.1, 0, 0.01 * k)))
        write_track(tmp_path, f"l{k}", motion(5, (0.5, 0, 0.01 * k)))
        write_frames(tmp_path, f"s{k}")
        write_frames(tmp_path, f"l{k}", ending="jpg")
    write_track(tmp_path, "short", motion(1), length=29)
    return tmp_path


def test_relative_pose_takes_source_points_to_the_target(tmp_path):
    T_1_0 = motion(10, (0.1, -0.2, 0.05))
    cameras = realestate10k.read_track(write_track(tmp_path, "a", T_1_0))
    assert len(cameras) == 30 and cameras[29].timestamp == 29000
    world = np.array([[0.3, 0.4, 5.0], [-1.0, 0.2, 4.0]])
    in0, in1 = (transform(cameras[k].T_camera_world, world) for k in (0, 29))
    T = realestate10k.relative(cameras[0], cameras[29])
    np.testing.assert_allclose(transform(T, in0), in1, atol=1e-12)
    np.testing.assert_allclose(T, T_1_0, atol=1e-12)


def test_pixels_have_their_centres_at_integers():
    """The middle of the image, 0.5 of its width, lies between the two middle pixels."""
    K = realestate10k.Camera(0, 0.5, 0.9, 0.5, 0.5, np.eye(4)).K(WIDTH, HEIGHT)
    np.testing.assert_allclose(K, [[32, 0, 31.5], [0, 32.4, 17.5], [0, 0, 1]])
    np.testing.assert_allclose(project(K, np.array([0.0, 0.0, 1.0])), [(WIDTH - 1) / 2, (HEIGHT - 1) / 2])


@pytest.mark.parametrize(
    ("degrees", "metres", "category"),
    [(15, 0.3, "small"), (15.1, 0.3, "large"), (15, 0.301, "large"), (0, 0, "small"), (170, 0, "large")],
)
def test_categories(degrees, metres, category):
    assert category_of(motion(degrees, (0, 0, metres))) == category


def test_a_list_is_sampled_by_seed_written_and_read(clips):
    records = realestate10k.sample(clips, each=3, seed=4)
    assert Counter(record.category for record in records) == {"small": 3, "large": 3}
    assert {(record.i, record.j, record.seed, record.scale, record.scale_text) for record in records} == {
        (0, 29, 4, 1.0, "raw")
    }
    pairs = load("realestate10k", clips)
    assert [pair.id for pair in pairs] == [f"{record.clip}/0-29" for record in records]
    assert {pair.id[0]: pair.category for pair in pairs} == {"s": "small", "l": "large"}
    assert pairs[0].points.shape == (0, 3) and pairs[0].source.depth is None and pairs[0].scale == "raw"
    assert pairs[0].source.rgb[0, 0].tolist() == [30, 20, 10]
    np.testing.assert_allclose(pairs[0].T_target_source, records[0].T_1_0, atol=1e-12)
    assert len(load("realestate10k", clips, limit=2)) == 2

    def again(seed):
        (clips / "pairs_test.jsonl").unlink()
        return [record.clip for record in realestate10k.sample(clips, each=3, seed=seed)]

    assert again(4) == [record.clip for record in records]
    assert len({tuple(again(seed)) for seed in range(5)}) > 1


def test_only_the_list_is_evaluated(clips):
    realestate10k.sample(clips, each=1)
    for path in (clips / "cameras" / "test").glob("*"):
        path.unlink()
    assert len(load("realestate10k", clips)) == 2


def test_a_list_is_written_once(clips):
    realestate10k.sample(clips, each=1)
    with pytest.raises(ValueError, match=r"pairs_test.jsonl exists: .* remove it"):
        realestate10k.sample(clips, each=1)


def test_validation_pairs_come_from_the_training_tracks(tmp_path):
    write_track(tmp_path, "t0", motion(1), "train")
    write_track(tmp_path, "t1", motion(30), "train")
    for clip in ("t0", "t1"):
        write_frames(tmp_path, clip)
    realestate10k.sample(tmp_path, split="validation", each=1)
    assert [pair.id for pair in load("realestate10k-validation", tmp_path)] == ["t0/0-29", "t1/0-29"]
    with pytest.raises(MissingFiles, match=r"pairs_test\.jsonl; expected the list that"):
        load("realestate10k", tmp_path)


def test_missing_frames_of_the_choice_are_all_listed_at_once(clips):
    whole = realestate10k.sample(clips, each=3)
    (clips / "pairs_test.jsonl").unlink()
    for path in (clips / "frames").rglob("*.*"):
        path.unlink()
    with pytest.raises(MissingFiles, match=r"12 missing: .* and 9 more; expected cameras/SPLIT") as caught:
        realestate10k.sample(clips, each=3)
    assert {file.parent.name for file in caught.value.files} == {record.clip for record in whole}
    assert not (clips / "pairs_test.jsonl").exists()


def test_clips_without_frames_or_sense_can_be_left_out_and_are_named(clips):
    (clips / "frames" / "s0" / "0.png").unlink()
    write_track(clips, "l0", motion(5, (0.5, 0, 0)) * 1.1)
    skipped = []
    records = realestate10k.sample(clips, each=5, skipped=skipped)
    assert len(records) == 10 and len(skipped) <= 2
    assert not {"s0", "l0"} & {record.clip for record in records}
    with pytest.raises(ValueError, match="1 small and 1 large pairs are wanting of 6 each"):
        (clips / "pairs_test.jsonl").unlink()
        realestate10k.sample(clips, each=6, skipped=(skipped := []))
    assert sorted(line.split(":")[0] for line in skipped) == ["l0", "s0"]


BAD_LINES = [
    (track_line(0, motion()).rsplit(" ", 1)[0], "18 columns, expected 19"),
    (track_line("x1", motion()), "x1"),
    (track_line(0.5, motion()), "timestamp '0.5', expected whole microseconds"),
    (track_line(0, motion(t=(np.nan, 0, 0))), "NaN or infinity"),
    (track_line(0, 1.001 * motion()), r"determinant 1\.003, expected a rotation"),
    (track_line(0, motion() * (1, -1, 1, 1)), "determinant -1"),
    (track_line(0, motion() + 0.05 * np.eye(4, k=1)), "no rigid motion"),
    (track_line(0, motion(), distortion=(0, 0.1)), r"distortion 0 0\.1, expected zeros"),
    (track_line(0, motion(), camera=(0.5, 0, 0.5, 0.5)), "expected both positive"),
]


@pytest.mark.parametrize(("line", "words"), BAD_LINES)
def test_a_malformed_track_names_file_and_line(tmp_path, line, words):
    path = tmp_path / "clip.txt"
    path.write_text("url\n" + track_line(0, motion()) + "\n\n" + line + "\n")
    with pytest.raises(ValueError, match=rf"clip\.txt:4: .*{words}") as caught:
        realestate10k.read_track(path)
    assert "\n" not in str(caught.value)


def test_a_track_starts_with_the_url(tmp_path):
    path = tmp_path / "clip.txt"
    path.write_text(track_line(0, motion()) + "\n")
    with pytest.raises(ValueError, match=r"clip\.txt:1: 19 words, expected the URL"):
        realestate10k.read_track(path)


def test_scale_is_recovered_in_spite_of_outliers(tmp_path):
    depth, K, points = write_sparse(tmp_path, "a", factor=1.7, outliers=24)
    found = sfm_scale.depth_scale(depth.astype(np.float32), K, points, rng_of("a"))
    assert found == pytest.approx(1.7, rel=1e-6)
    plain = np.exp(sfm_scale.log_ratios(depth.astype(np.float32), K, points).mean())
    assert plain < 1.5, "the outliers matter"


def test_without_agreement_the_plain_mean_is_taken():
    values = 10.0 ** np.arange(10)
    assert sfm_scale.robust_mean(values, rng_of("a")) == values.mean()


def test_points_out_of_view_behind_or_without_depth_do_not_count(tmp_path):
    depth, K, points = write_sparse(tmp_path, "a", factor=2.0, count=12)
    useless = np.array([[0, 0, -1.0], [9, 0, 1.0], [0, np.nan, 1.0]])
    given = depth.astype(np.float32)
    found = sfm_scale.log_ratios(given, K, np.vstack([points, useless]))
    np.testing.assert_allclose(found, np.log(2.0))
    given[:] = np.nan
    with pytest.raises(ValueError, match="0 sparse points fall on depth: expected at least 10"):
        sfm_scale.depth_scale(given, K, points, rng_of("a"))


@pytest.mark.parametrize("text", [False, True])
def test_the_scale_decides_translation_and_category_and_is_recorded(tmp_path, text):
    for clip, t in (("a", 0.1), ("b", 0.2)):  # with metres of 2 units each: 0.2 m is small, 0.4 m is large
        write_track(tmp_path, clip, motion(3, (t, 0, 0)))
        write_frames(tmp_path, clip)
        write_sparse(tmp_path, clip, factor=2.0, outliers=15)
        if text:
            packed = tmp_path / "points" / f"{clip}.npz"
            np.savetxt(packed.with_suffix(".txt"), np.load(packed)["points"])
            packed.unlink()
    small, large = realestate10k.sample(tmp_path, scale="sfm-depth", each=1)
    assert (small.clip, large.clip) == ("a", "b")
    assert small.scale == pytest.approx(2.0, rel=1e-6) and small.scale_source == "sfm-depth"
    pairs = load("realestate10k", tmp_path)
    assert [pair.scale for pair in pairs] == ["sfm-depth x2", "sfm-depth x2"]
    np.testing.assert_allclose(pairs[1].T_target_source[:3, 3], [0.4, 0, 0], atol=1e-6)


def test_too_few_points_are_refused_and_named(tmp_path):
    write_track(tmp_path, "a", motion())
    write_frames(tmp_path, "a")
    write_sparse(tmp_path, "a", factor=2.0, count=9)
    with pytest.raises(ValueError, match=r"a\.npz: 9 sparse points"):
        realestate10k.sample(tmp_path, scale="sfm-depth", each=1)
    (tmp_path / "depth" / "a" / "0.png").unlink()
    with pytest.raises(MissingFiles, match=r"depth/a/0\.png; .* points/CLIP"):
        realestate10k.sample(tmp_path, scale="sfm-depth", each=1)
    np.savez(tmp_path / "points" / "a.npz", points=np.zeros((3, 2)))
    with pytest.raises(ValueError, match="`points`, Nx3"):
        sfm_scale.read_points(tmp_path / "points" / "a.npz")
    with pytest.raises(ValueError, match="expected one of raw, sfm-depth"):
        realestate10k.sample(tmp_path, scale="metres")
    with pytest.raises(ValueError, match="expected one of test, validation"):
        realestate10k.sample(tmp_path, split="all")


def changed(line, **values):
    return json.dumps(json.loads(line) | values)


BAD_RECORDS = [
    (lambda line: line[:-5], "delimiter|Expecting|Unterminated"),
    (lambda line: "[1]", "expected an object"),
    (lambda line: "[" * 100_000, "recursion|Expecting"),
    (lambda line: json.dumps({"clip": "a"}), "expected an object with clip, i, j"),
    (lambda line: changed(line, extra=1), r"differs in \['extra'\]"),
    (lambda line: changed(line, i=-1), "i is '-1': expected a number from 0"),
    (lambda line: changed(line, i=True), "expected a number from 0"),
    (lambda line: changed(line, clip=""), "expected text"),
    (lambda line: changed(line, image0="../secret.png"), "below the data set's folder"),
    (lambda line: changed(line, image1="/secret.png"), "below the data set's folder"),
    (lambda line: changed(line, size0=[640]), "expected .width, height."),
    (lambda line: changed(line, K0=[[1, 2], [3, 4]]), "K has shape"),
    (lambda line: changed(line, T_1_0=np.zeros((4, 4)).tolist()), "T_1_0 has last row"),
    (lambda line: changed(line, T_1_0=np.diag([1, 1, -1, 1]).tolist()), "no rigid motion"),
    (lambda line: changed(line, scale=2.0), "positive number, 1 for raw"),
    (lambda line: changed(line, scale=float("nan"), scale_source="sfm-depth"), "positive number"),
    (lambda line: changed(line, scale=10**400, scale_source="sfm-depth"), "too large"),
    (lambda line: changed(line, category="medium"), "category is 'medium': expected '(small|large)'"),
    (lambda line: changed(line, category="large" if '"small"' in line else "small"), "category is"),
    (lambda line: line.replace("\n", "") + "\n" + line, "is there twice"),
]


@pytest.mark.parametrize(("spoil", "words"), BAD_RECORDS)
def test_a_damaged_list_names_file_and_line(clips, spoil, words):
    realestate10k.sample(clips, each=2)
    path = clips / "pairs_test.jsonl"
    first, second, *_ = path.read_text().splitlines()
    path.write_text(f"{first}\n\n{spoil(second)}\n")
    with pytest.raises(ValueError, match=rf"pairs_test\.jsonl:[34]: .*({words})") as caught:
        load("realestate10k", clips)
    assert "\n" not in str(caught.value)


def test_a_list_survives_writing_and_reading_exactly(clips):
    records = realestate10k.sample(clips, each=2)
    for before, after in zip(records, pair_list.read_list(clips / "pairs_test.jsonl"), strict=True):
        for name in ("K0", "K1", "T_1_0"):
            np.testing.assert_allclose(getattr(before, name), getattr(after, name), atol=1e-14)
        assert (before.id, before.size0, before.scale) == (after.id, after.size0, after.scale)


def test_images_of_another_size_than_the_list_was_made_for_are_refused(clips):
    record, *_ = realestate10k.sample(clips, each=1)
    cv2.imwrite(str(clips / record.image0), np.zeros((72, 128, 3), np.uint8))
    with pytest.raises(ValueError, match="128x72, but the pair list was made for 64x36"):
        load("realestate10k", clips)


def test_any_set_with_a_pair_list_can_be_read(clips):
    realestate10k.sample(clips, each=1)
    (clips / "pairs_test.jsonl").rename(clips / "pairs.jsonl")
    assert [pair.set for pair in load("pair-list", clips)] == ["pair-list"] * 2
    skipped = []
    for path in (clips / "frames").rglob("*.jpg"):
        path.unlink()
    assert [pair.category for pair in load("pair-list", clips, skipped=skipped)] == ["small"]
    assert len(skipped) == 1 and "/0-29: " in skipped[0]
    with pytest.raises(MissingFiles, match=r"2 missing: .*expected pairs\.jsonl and the images"):
        load("pair-list", clips)


def test_unknown_readers_and_folders(tmp_path):
    with pytest.raises(ValueError, match="no reader 'kitti': expected one of mapfree, "):
        load("kitti", tmp_path)
    for name in READERS:
        with pytest.raises(ValueError, match="expected"):
            load(name, tmp_path)
        with pytest.raises(ValueError, match="is no folder"):
            load(name, tmp_path / "none")


def test_inputs_are_bounded(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match="no UTF-8 text"):
        text_of(path)
    np.savez_compressed(tmp_path / "bomb.npz", points=np.zeros(10_000))
    monkeypatch.setattr("bench.pairs.readers.dataset_files.MAX_BYTES", 2000)
    with pytest.raises(ValueError, match="unpacked"):
        arrays(tmp_path / "bomb.npz")
    path.write_bytes(b"1" * 2001)
    with pytest.raises(ValueError, match="0 MB, expected at most"):
        rows(path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no archive", b"\x80\x04N."])
def test_an_array_file_that_is_none_is_refused(tmp_path, content):
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.npz: .*expected an \.npz file of plain arrays"):
        arrays(path)


def test_objects_in_an_array_file_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", points=np.array([{"a": 1}], object))
    with pytest.raises(ValueError, match="allow_pickle"):
        arrays(tmp_path / "a.npz")


def test_small_helpers(tmp_path):
    assert chosen([], 3, rng_of("a")) == []
    assert chosen("abc", 5, rng_of("a")) == ["a", "b", "c"]
    assert frame_gaps({"a": 3, "b": 1}, 2) == [("a", 0)]
    with pytest.raises(ValueError, match="gap is 0"):
        frame_gaps({"a": 3}, 0)
    assert inside(tmp_path, "a/b.png", "here") == tmp_path / "a" / "b.png"


def test_recorded_pairs_are_looked_for_beside_the_checkout():
    """Where there are none, a run by default leaves them out, so a wrong folder would go unnoticed."""
    assert pairs_json.DATA == DATA
