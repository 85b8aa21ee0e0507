# SPDX-License-Identifier: Apache-2.0
"""Readers of ScanNet-1500, Map-free, TUM RGB-D and 7-Scenes, on a made scene of a wall seen from two places."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.pairs.readers import MissingFiles, load, mapfree, scannet1500, seven_scenes, tum
from garps_core.geometry import project, se3_inverse, transform

WIDTH, HEIGHT = 640, 480
WALL_M = 2.5
T_1_0 = np.eye(4)
T_1_0[:3, :3] = Rotation.from_rotvec(np.radians([2.0, -6.0, 4.0])).as_matrix()
T_1_0[:3, 3] = 0.12, -0.05, 0.08
T_WORLD_0 = np.eye(4)
T_WORLD_0[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix()
T_WORLD_0[:3, 3] = 1.0, -2.0, 0.5
T_WORLD_1 = T_WORLD_0 @ se3_inverse(T_1_0)
IDENTITY = np.eye(4)


def wall_depth(K, T_camera_wall, shape=(HEIGHT, WIDTH)):
    """HxW m: depth of the plane z = 2.5 m of the wall's frame."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    normal = T_camera_wall[:3, 2]
    return (WALL_M + normal @ T_camera_wall[:3, 3]) / (rays @ normal)


def put(path, content):
    """Write an image, a matrix or text."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, str):
        path.write_text(content)
    elif path.suffix == ".txt":
        np.savetxt(path, content)
    else:
        cv2.imwrite(str(path), content)


def colour(width=WIDTH, height=HEIGHT):
    return np.full((height, width, 3), (10, 20, 30), np.uint8)


def check_geometry(pair):
    """The source's points are on the wall, and lie where the target's depth says."""
    assert pair.points.shape[1] == 3 and len(pair.points) > 1000
    assert pair.source.rgb[HEIGHT // 2, WIDTH // 2].tolist() == [30, 20, 10]
    np.testing.assert_allclose(pair.points[:, 2], WALL_M, atol=2e-3)
    moved = transform(pair.T_target_source, pair.points)
    u, v = project(pair.target.K, moved).round().astype(int).T
    seen = (u >= 0) & (v >= 0) & (u < WIDTH) & (v < HEIGHT)
    assert seen.mean() > 0.5
    off = pair.target.depth[v[seen], u[seen]] - moved[seen, 2]
    assert np.nanmax(np.abs(off)) < 5e-3
    np.testing.assert_allclose(pair.T_target_source, T_1_0, atol=1e-6)
    assert pair.category == "small" and pair.scale == "metres"


# ScanNet-1500

K_SCANNET = np.array([[577.87, 0, 319.5], [0, 577.87, 239.5], [0, 0, 1]])


def as_4x4(K):
    M = np.eye(4)
    M[:3, :3] = K
    return M


@pytest.fixture
def scannet(tmp_path):
    scene = tmp_path / "scene0707_00"
    for frame, T_world, T_wall in ((15, T_WORLD_0, IDENTITY), (585, T_WORLD_1, T_1_0)):
        put(scene / "color" / f"{frame}.jpg", colour(1296, 968))
        put(scene / "depth" / f"{frame}.png", np.round(1000 * wall_depth(K_SCANNET, T_wall)).astype(np.uint16))
        put(scene / "pose" / f"{frame}.txt", T_world)
    put(scene / "intrinsic" / "intrinsic_depth.txt", as_4x4(K_SCANNET))
    np.savez(tmp_path / "test.npz", name=[[707, 0, 15, 585]], rel_pose=[T_1_0[:3].ravel()])
    return tmp_path


def test_scannet(scannet):
    (pair,) = load("scannet1500", scannet)
    check_geometry(pair)
    assert pair.id == "scene0707_00/15-585" and pair.source.rgb.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_array_equal(pair.source.K, K_SCANNET)
    (bare,) = load("scannet1500", scannet, depth=False)
    assert bare.source.depth is None and bare.points.shape == (0, 3)


def test_scannet_colour_intrinsics_follow_the_resizing(scannet):
    intrinsics = scannet / "scene0707_00" / "intrinsic"
    (intrinsics / "intrinsic_depth.txt").unlink()
    put(intrinsics / "intrinsic_color.txt", as_4x4([[1170, 0, 647.5], [0, 1170, 483.5], [0, 0, 1]]))
    (pair,) = load("scannet1500", scannet)
    np.testing.assert_allclose(pair.source.K[:2, 2], [319.5, 239.5])
    np.testing.assert_allclose(np.diag(pair.source.K)[:2], [1170 * 640 / 1296, 1170 * 480 / 968])
    for frame in (15, 585):
        put(scannet / "scene0707_00" / "color" / f"{frame}.jpg", colour())
    with pytest.raises(ValueError, match=r"intrinsic_color\.txt: cx is 647\.5 px at a width of 640"):
        load("scannet1500", scannet)


def test_resized_intrinsics_keep_the_corners():
    """The outer corner of the last pixel stays the outer corner."""
    K = np.array([[1000.0, 0, 600.0], [0, 1000.0, 400.0], [0, 0, 1]])
    new = scannet1500.resized_intrinsics(K, (1296, 968), (640, 480))
    at = np.array([(1295.5 - 600) / 1000, (967.5 - 400) / 1000, 1.0])
    np.testing.assert_allclose(project(new, at), [639.5, 479.5])


def test_scannet_missing_files_are_listed_or_left_out(scannet):
    np.savez(scannet / "test.npz", name=[[707, 0, 15, 585], [707, 0, 15, 30], [806, 1, 0, 7]])
    with pytest.raises(MissingFiles, match=r"10 missing: .*color/30\.jpg.* and 7 more; expected test\.npz and scene"):
        load("scannet1500", scannet)
    skipped = []
    assert len(load("scannet1500", scannet, skipped=skipped)) == 1
    assert [line.split(":")[0] for line in skipped] == ["scene0707_00/15-30", "scene0806_01/0-7"]


def test_scannet_refuses_a_table_or_poses_that_make_no_sense(scannet):
    np.savez(scannet / "test.npz", name=[[707, 0, 15, 585]], rel_pose=[se3_inverse(T_1_0)[:3].ravel()])
    with pytest.raises(ValueError, match=r"rel_pose is 0\.\d+ m and 15 deg off the pose files"):
        load("scannet1500", scannet)
    for table in ({"name": np.zeros((2, 3), int)}, {"name": [["a"] * 4]}, {"names": np.zeros((1, 4), int)}):
        np.savez(scannet / "test.npz", **table)
        with pytest.raises(ValueError, match=r"test\.npz: expected an array `name`"):
            load("scannet1500", scannet)
    np.savez(scannet / "test.npz", name=[[707, 0, 15, 585]], rel_pose=[[1.0]])
    with pytest.raises(ValueError, match=r"`rel_pose` is float64 \(1, 1\), expected \(1, 12\)"):
        load("scannet1500", scannet)
    np.savez(scannet / "test.npz", name=[[707, 0, 15, 585]])
    for content, words in (
        ("-inf " * 4 + "\n", r"1 rows, expected a 4x4"),
        ("-inf 0 0 0\n" * 4, r"15\.txt:1: NaN or inf"),
    ):
        put(scannet / "scene0707_00" / "pose" / "15.txt", content)
        with pytest.raises(ValueError, match=words):
            load("scannet1500", scannet)
    put(scannet / "scene0707_00" / "pose" / "15.txt", 2 * T_WORLD_0)
    with pytest.raises(ValueError, match=r"15\.txt: pose has last row"):
        load("scannet1500", scannet)


def test_damaged_images_are_named(scannet):
    depth = scannet / "scene0707_00" / "depth" / "15.png"
    put(depth, colour())
    with pytest.raises(ValueError, match=r"depth/15\.png: expected a 16-bit image"):
        load("scannet1500", scannet)
    put(depth, np.zeros((10, 10), np.uint16))
    with pytest.raises(ValueError, match=r"color/15\.jpg: depth is 10x10 but rgb is 480x640"):
        load("scannet1500", scannet)
    put(scannet / "scene0707_00" / "color" / "585.jpg", "no image")
    put(depth, np.full((HEIGHT, WIDTH), 2500, np.uint16))
    with pytest.raises(ValueError, match=r"585\.jpg: no image that can be read"):
        load("scannet1500", scannet)


# Map-free


def pose_line(name, T):
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return f"{name} {w} {x} {y} {z} {' '.join(map(str, T[:3, 3]))}\n"


@pytest.fixture
def mapfree_val(tmp_path):
    scene = tmp_path / "s00460"
    queries = [f"seq1/frame_{k:05d}.jpg" for k in (0, 1, 2, 4, 5, 6, 7)]
    names = ["seq0/frame_00000.jpg", *queries]
    poses = [IDENTITY] * 6 + [T_1_0] * 2
    put(scene / "poses.txt", "# image q t\n" + "".join(map(pose_line, names, poses)))
    put(scene / "intrinsics.txt", "".join(f"{name} 590 591 269.5 359.5 540 720\n" for name in names))
    for name in (names[0], queries[0], queries[5]):
        put(scene / name, colour(540, 720))
    return tmp_path


def test_mapfree(mapfree_val):
    first, second = load("mapfree", mapfree_val)
    assert (first.id, second.id) == ("s00460/frame_00000", "s00460/frame_00006"), "every 5th of those that are there"
    np.testing.assert_allclose(second.T_target_source, T_1_0, atol=1e-12)
    np.testing.assert_array_equal(second.target.K, [[590, 0, 269.5], [0, 591, 359.5], [0, 0, 1]])
    assert first.source is second.source, "read once"
    assert second.points.shape == (0, 3) and second.source.rgb.shape == (720, 540, 3)


def test_mapfree_pose_is_relative_to_the_reference(mapfree_val):
    poses = mapfree_val / "s00460" / "poses.txt"
    T_0_world = se3_inverse(T_WORLD_0)
    put(poses, pose_line("seq0/frame_00000.jpg", T_0_world) + pose_line("seq1/frame_00000.jpg", T_1_0 @ T_0_world))
    (pair,) = load("mapfree", mapfree_val)
    np.testing.assert_allclose(pair.T_target_source, T_1_0, atol=1e-12)


def test_mapfree_missing_and_malformed(mapfree_val):
    scene = mapfree_val / "s00460"
    (scene / "seq1" / "frame_00006.jpg").unlink()
    with pytest.raises(MissingFiles, match=r"1 missing: .*frame_00006\.jpg; expected sNNNNN/"):
        load("mapfree", mapfree_val)
    assert len(load("mapfree", mapfree_val, skipped=(skipped := []))) == len(skipped) == 1
    put(scene / "seq1" / "frame_00000.jpg", colour(270, 360))
    with pytest.raises(ValueError, match=r"intrinsics\.txt:2: 540x720, but the image is 270x360"):
        load("mapfree", mapfree_val, skipped=[])
    zero = "seq0/frame_00000.jpg 1 0 0 0 0 0 0\nseq1/frame_00000.jpg 0 0 0 0 0 0 0\n"
    cases = [
        (zero, r"poses\.txt:2: quaternion of length 0, .*withheld"),
        (zero.replace("1 0 0", "1 0 x"), r"poses\.txt:1: could not convert string to float: 'x'"),
        (zero + "seq1/frame_00001.jpg 1 0 0\n", r"poses\.txt:3: 3 columns, expected 7: qw"),
        (zero + "../up.jpg 1 0 0 0 0 0 0\n", r"poses\.txt:3: path '\.\./up\.jpg'"),
        (zero + "seq0/frame_00001.jpg 1 0 0 0 0 0 0\n", "expected one reference"),
    ]
    for text, words in cases:
        put(scene / "poses.txt", text)
        with pytest.raises(ValueError, match=words):
            load("mapfree", mapfree_val)
    put(scene / "poses.txt", pose_line("seq0/frame_00000.jpg", IDENTITY) + pose_line("seq1/frame_00000.jpg", IDENTITY))
    put(scene / "intrinsics.txt", "seq1/frame_00000.jpg 590 591 269.5 359.5 540 720\n")
    with pytest.raises(ValueError, match=r"intrinsics\.txt: no line for seq0"):
        load("mapfree", mapfree_val)
    (scene / "intrinsics.txt").unlink()
    with pytest.raises(MissingFiles, match=r"intrinsics\.txt"):
        mapfree.read(mapfree_val)


# TUM RGB-D


def tum_pose(stamp, T):
    numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
    return f"{stamp} " + " ".join(map(str, numbers)) + "\n"


@pytest.fixture
def tum_sequence(tmp_path):
    """Frames 0 and 2 see the wall from the two places; frame 1 has no depth in time; frame 3 no truth."""
    folder = tmp_path / "rgbd_dataset_freiburg3_made"
    K = np.array([[535.4, 0, 320.1], [0, 539.2, 247.6], [0, 0, 1]])
    rgb, depth = ["# colour\n"], ["# depth\n"]
    for stamp, late, T_wall in ((10.0, 0.015, IDENTITY), (11.0, 0.03, IDENTITY), (12.0, -0.019, T_1_0), (13, 0, T_1_0)):
        put(folder / "rgb" / f"{stamp}.png", colour())
        put(folder / "depth" / f"{stamp}.png", np.round(5000 * wall_depth(K, T_wall)).astype(np.uint16))
        rgb.append(f"{stamp} rgb/{stamp}.png\n")
        depth.append(f"{stamp + late} depth/{stamp}.png\n")
    truth = [(9.99, T_WORLD_1), (10.001, T_WORLD_0), (11.0, T_WORLD_0), (12.002, T_WORLD_1)]
    put(folder / "rgb.txt", "".join(rgb))
    put(folder / "depth.txt", "".join(reversed(depth)))
    put(folder / "groundtruth.txt", "# stamp t q\n" + "".join(tum_pose(*line) for line in truth))
    return folder


def test_tum(tum_sequence):
    (pair,) = load("tum", tum_sequence, gap=1)
    check_geometry(pair)
    assert pair.id == "rgbd_dataset_freiburg3_made/10.0-12.0"
    with pytest.raises(ValueError, match="no pairs found"):
        load("tum", tum_sequence, gap=2)


def test_tum_series_decide_the_camera(tum_sequence):
    (pair,) = load("tum", tum_sequence, gap=1, series="freiburg1")
    assert pair.source.K[0, 0] == pytest.approx(517.306408)
    (straight,) = load("tum", tum_sequence, gap=1)
    assert (pair.source.rgb != straight.source.rgb).any(), "undistorted"
    assert np.isnan(pair.source.depth).sum() > np.isnan(straight.source.depth).sum()
    plain = tum_sequence.rename(tum_sequence.with_name("office"))
    with pytest.raises(ValueError, match="series '', expected one of freiburg1, freiburg2, freiburg3"):
        load("tum", plain)


def test_nearest_stamps():
    found = tum.nearest(np.array([3.0, 1.0, 2.0]), np.array([0.0, 0.99, 1.4, 1.6, 2.5, 3.01, 9.0]), 0.5)
    assert found.tolist() == [-1, 1, 1, 2, 2, 0, -1]
    assert tum.nearest(np.array([1.0]), np.array([1.01, 2.0]), 0.02).tolist() == [0, -1]
    assert tum.nearest(np.zeros(0), np.array([1.0]), 0.02).tolist() == [-1]


def test_tum_missing_and_malformed(tum_sequence):
    (tum_sequence / "rgb" / "12.0.png").unlink()
    with pytest.raises(MissingFiles, match=r"1 missing: .*rgb/12\.0\.png; expected rgb\.txt, depth\.txt"):
        load("tum", tum_sequence, gap=1)
    for name, line, words in (
        ("groundtruth.txt", "1 2 3", r"groundtruth\.txt:1: 3 columns, expected 8"),
        ("groundtruth.txt", "1 0 0 0 0 0 0 2", "quaternion of length 2"),
        ("rgb.txt", "1 a b", r"rgb\.txt:1: 3 columns, expected 2: stamp file"),
        ("rgb.txt", "one rgb/a.png", r"rgb\.txt:1: could not convert .*'one'"),
        ("depth.txt", "1 /a.png", r"depth\.txt:1: path '/a\.png'"),
    ):
        before = (tum_sequence / name).read_text()
        put(tum_sequence / name, line + "\n")
        with pytest.raises(ValueError, match=words):
            load("tum", tum_sequence, gap=1)
        put(tum_sequence / name, before)
    (tum_sequence / "depth.txt").unlink()
    with pytest.raises(MissingFiles, match=r"depth\.txt"):
        load("tum", tum_sequence)


# 7-Scenes


@pytest.fixture
def chess(tmp_path):
    folder = tmp_path / "chess"
    put(folder / "TestSplit.txt", "sequence3\nsequence12\n")
    for sequence, length in (("seq-03", 4), ("seq-12", 2)):
        for k in range(length):
            T_world, T_wall = (T_WORLD_0, IDENTITY) if k % 2 == 0 else (T_WORLD_1, T_1_0)
            depth = np.round(1000 * wall_depth(seven_scenes.K, T_wall)).astype(np.uint16)
            depth[:8], depth[8:16] = 65535, 0
            frame = folder / sequence / f"frame-{k:06d}"
            put(frame.with_name(frame.name + ".color.png"), colour())
            put(frame.with_name(frame.name + ".depth.png"), depth)
            put(frame.with_name(frame.name + ".pose.txt"), T_world)
    return folder


def test_seven_scenes(chess):
    pairs = load("seven_scenes", chess, gap=1)
    assert [pair.id for pair in pairs] == [
        *(f"chess/seq-03/frame-{k:06d}-{k + 1:06d}" for k in range(3)), "chess/seq-12/frame-000000-000001",
    ]  # fmt: skip
    check_geometry(pairs[0])
    check_geometry(pairs[3])
    assert np.isnan(pairs[0].source.depth[:16]).all() and np.isfinite(pairs[0].source.depth[16:]).all()
    np.testing.assert_allclose(pairs[1].T_target_source, se3_inverse(T_1_0), atol=1e-9)


def test_pairs_are_drawn_by_seed(chess):
    def ids(seed):
        return [pair.id for pair in load("seven_scenes", chess, gap=1, count=2, seed=seed)]

    assert ids(1) == ids(1) and len(ids(1)) == 2
    assert len({tuple(ids(seed)) for seed in range(6)}) > 1


def test_seven_scenes_missing_and_malformed(chess):
    (chess / "seq-03" / "frame-000001.pose.txt").unlink()
    with pytest.raises(MissingFiles, match=r"1 missing: .*frame-000001\.pose\.txt; expected TestSplit\.txt"):
        load("seven_scenes", chess, gap=1)
    assert len(load("seven_scenes", chess, gap=1, skipped=(skipped := []))) == 2 == len(skipped)
    put(chess / "TestSplit.txt", "sequence3\nfourth\n")
    with pytest.raises(ValueError, match=r"TestSplit\.txt:2: 'fourth', expected for instance 'sequence3'"):
        load("seven_scenes", chess)
    put(chess / "TestSplit.txt", "sequence5\n")
    with pytest.raises(ValueError, match=r"no pairs found: expected TestSplit\.txt"):
        load("seven_scenes", chess)
