# SPDX-License-Identifier: Apache-2.0
"""CameraInfo to the camera of the delivered image, and undistortion against formulas written out here."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ros_messages import LIBRARIES, camera_info, changed

from msg_adapters import MessageError, camera_from_info
from msg_adapters.cameras import says_rectified
from msg_adapters.undistort import _tables

K = np.array([[50.0, 0, 31.5], [0, 52.0, 23.5], [0, 0, 1]])
P = np.array([[45.0, 0, 30.0, -4.5], [0, 45.0, 22.0, 0], [0, 0, 1, 0]])
PLUMB_BOB = (-0.28, 0.07, 0.001, -0.002, 0.01)
RATIONAL = (0.4, -0.1, 0.001, -0.0005, 0.01, 0.6, -0.2, 0.03)
FISHEYE = (0.05, -0.01, 0.003, -0.001)
TURNED = cv2.Rodrigues(np.array([0.0, 0.02, 0.0]))[0]


@pytest.mark.parametrize("library", LIBRARIES)
def test_raw_image_uses_k_and_d(library):
    camera = camera_from_info(
        camera_info(library, K=K, P=P, D=PLUMB_BOB, model="plumb_bob"), (64, 48), topic="/image_raw"
    )
    np.testing.assert_array_equal(camera.K, K)
    assert camera.K.dtype == np.float64 and (camera.width, camera.height) == (64, 48)
    assert (camera.distortion_model, camera.coefficients) == ("plumb_bob", PLUMB_BOB)
    assert camera.decision == "raw image (topic /image_raw): K with plumb_bob distortion; R not applied"


@pytest.mark.parametrize("library", LIBRARIES)
def test_rectified_image_uses_p_without_distortion(library):
    info = camera_info(library, K=K, P=P, R=TURNED, D=PLUMB_BOB, model="plumb_bob")
    camera = camera_from_info(info, (64, 48), topic="/left/image_rect")
    np.testing.assert_array_equal(camera.K, P[:, :3])
    assert camera.distortion_model == "" and camera.coefficients == ()
    assert camera.decision.startswith("rectified image (topic /left/image_rect): P without distortion")
    assert "the pose is of this camera" in camera.decision and "turned by R" in camera.decision


def test_the_notes_of_a_rectified_pair_appear_only_where_they_hold():
    camera = camera_from_info(camera_info(K=K), rectified="true")
    assert camera.decision == "rectified image (rectified:=true): P without distortion"


def test_rectifying_rotation_does_not_change_a_raw_camera():
    plain = camera_from_info(camera_info(D=PLUMB_BOB, model="plumb_bob"))
    turned = camera_from_info(camera_info(D=PLUMB_BOB, model="plumb_bob", R=TURNED))
    x, y = _tables(tuple(plain.K.ravel()), "plumb_bob", PLUMB_BOB, 64, 48)
    depth = np.random.default_rng(0).random((48, 64)).astype(np.float32)
    for camera in (plain, turned):
        _, out = camera.rectify(np.zeros((48, 64, 3), np.uint8), depth)
        np.testing.assert_array_equal(out, cv2.remap(depth, x, y, cv2.INTER_NEAREST, borderValue=(np.nan,)))


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        ("/camera/image_rect", True),
        ("/camera/image_rect_color", True),
        ("/camera/image_rect/compressed", True),
        ("/camera/depth/image_rect_raw/compressedDepth", True),
        ("image_rectified", True),
        ("/camera/Rectified", True),
        ("/rect/image_raw", False),
        ("/rect/image_raw/compressed", False),
        ("/camera/image_unrectified", False),
        ("/camera/color_corrected", False),
        ("/camera/direct", False),
        ("/camera/image_raw", False),
        ("", False),
    ],
)
def test_auto_looks_at_the_last_part_of_the_topic(topic, expected):
    assert says_rectified(topic) is expected
    camera = camera_from_info(camera_info(K=K, P=P), topic=topic)
    assert camera.K[0, 0] == (P if expected else K)[0, 0]


def test_the_caller_overrules_the_topic():
    info = camera_info(K=K, P=P)
    assert camera_from_info(info, topic="/image_raw", rectified="true").K[0, 0] == P[0, 0]
    assert camera_from_info(info, topic="/image_rect", rectified="false").K[0, 0] == K[0, 0]


def test_region_of_interest_then_binning():
    info = camera_info(size=(64, 48), K=K, P=P, roi=(10, 6, 40, 30), binning_x=2, binning_y=3)
    camera = camera_from_info(info, (20, 10))
    np.testing.assert_allclose(camera.K, [[25, 0, (31.5 - 10) / 2], [0, 52 / 3, (23.5 - 6) / 3], [0, 0, 1]])
    assert "window 40x30 at (10, 6)" in camera.decision and "binning 2x3" in camera.decision
    rectified = camera_from_info(info, (20, 10), rectified="true")
    np.testing.assert_allclose(rectified.K, [[22.5, 0, 10], [0, 15, 16 / 3], [0, 0, 1]])


def test_no_window_says_nothing():
    assert "window" not in camera_from_info(camera_info(roi=(0, 0, 64, 48))).decision
    assert "binning" not in camera_from_info(camera_info(binning_x=1, binning_y=1)).decision


@given(st.integers(0, 30), st.integers(0, 20), st.integers(8, 30), st.integers(8, 20), st.integers(0, 4))
def test_windowed_camera_sees_the_pixels_of_the_window(x0, y0, width, height, binning):
    """A point's pixel in the window is its pixel in the full image, moved and divided."""
    point = np.array([0.1, -0.05, 1.0])
    info = camera_info(K=K, roi=(x0, y0, width, height), binning_x=binning, binning_y=binning)
    bins = max(binning, 1)
    camera = camera_from_info(info, (width // bins, height // bins))
    full, windowed = K @ point, camera.K @ point
    np.testing.assert_allclose(windowed[:2], (full[:2] - (x0, y0)) / bins, atol=1e-9)


@given(st.integers(1, 4), st.booleans())
def test_resized_camera_keeps_the_corners_of_the_image(factor, smaller):
    size, image_size = ((64, 48), (64 * factor, 48 * factor))
    info = camera_info(size=image_size, K=K) if smaller else camera_info(size=size, K=K)
    target = size if smaller else image_size
    camera = camera_from_info(info, target, allow_resized=True)
    scale = target[0] / (image_size if smaller else size)[0]
    # Rays through the outer corners (pixel centres at integers, corners at -0.5) stay what they were.
    corner = (np.array([-0.5, -0.5]) - K[:2, 2]) / np.diag(K)[:2]
    np.testing.assert_allclose((np.array([-0.5, -0.5]) - camera.K[:2, 2]) / np.diag(camera.K)[:2], corner, atol=1e-12)
    np.testing.assert_allclose(np.diag(camera.K)[:2], np.diag(K)[:2] * scale)
    assert ("resized" in camera.decision) == (factor != 1)


def plumb_bob(x, y, d):
    r2 = x * x + y * y
    radial = 1 + d[0] * r2 + d[1] * r2**2 + (d[4] if len(d) > 4 else 0) * r2**3
    if len(d) > 5:
        radial = radial / (1 + d[5] * r2 + d[6] * r2**2 + d[7] * r2**3)
    return (
        x * radial + 2 * d[2] * x * y + d[3] * (r2 + 2 * x * x),
        y * radial + d[2] * (r2 + 2 * y * y) + 2 * d[3] * x * y,
    )


def equidistant(x, y, d):
    r = np.sqrt(x * x + y * y)
    theta = np.arctan(r)
    bent = theta * (1 + d[0] * theta**2 + d[1] * theta**4 + d[2] * theta**6 + d[3] * theta**8)
    scale = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
    return x * scale, y * scale


LENSES = {
    "plumb_bob": (plumb_bob, PLUMB_BOB),
    "plumb_bob of 4": (plumb_bob, PLUMB_BOB[:4]),
    "rational_polynomial": (plumb_bob, RATIONAL),
    "rational_polynomial of 12": (plumb_bob, (*RATIONAL, 0, 0, 0, 0)),
    "rational_polynomial of 14": (plumb_bob, (*RATIONAL, 0, 0, 0, 0, 0, 0)),
    "equidistant": (equidistant, FISHEYE),
    "equidistant of zeros": (equidistant, (0, 0, 0, 0)),
    "fisheye": (equidistant, FISHEYE),
    "kannala_brandt": (equidistant, FISHEYE),
}


@pytest.mark.parametrize("name", LENSES)
def test_undistortion_samples_where_the_lens_formula_says(name):
    formula, coefficients = LENSES[name]
    camera = camera_from_info(camera_info(K=K, D=coefficients, model=name.split()[0]), (64, 48))
    v, u = np.mgrid[0:48, 0:64].astype(np.float64)
    x, y = formula((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], coefficients)
    raw_u, raw_v = x * K[0, 0] + K[0, 2], y * K[1, 1] + K[1, 2]
    ramp = np.dstack([u, v, 0 * u]).astype(np.uint8)  # an image whose colour is its own coordinate
    rgb, columns = camera.rectify(ramp, u.astype(np.float32))
    inside = (raw_u > 0.6) & (raw_u < 62.4) & (raw_v > 0.6) & (raw_v < 46.4)
    assert inside.mean() > 0.5
    assert np.abs(rgb[..., 0] - raw_u)[inside].max() <= 0.6  # linear, rounded to a whole grey value
    assert np.abs(rgb[..., 1] - raw_v)[inside].max() <= 0.6
    assert np.abs(columns - raw_u)[inside].max() <= 0.55  # nearest column
    assert set(np.unique(columns[np.isfinite(columns)])) <= set(range(64))  # never a mean of two readings
    assert np.abs(raw_u - u).max() > 1  # the lens bends by more than what is asserted


def test_outside_of_the_lens_is_black_and_has_no_depth():
    camera = camera_from_info(camera_info(K=K, D=(0.5, 0, 0, 0, 0), model="plumb_bob"))
    rgb, depth = camera.rectify(np.full((48, 64, 3), 200, np.uint8), np.ones((48, 64), np.float32))
    assert rgb[0, 0].tolist() == [0, 0, 0] and np.isnan(depth[0, 0])
    assert rgb[24, 32].tolist() == [200] * 3 and depth[24, 32] == 1
    assert depth.dtype == np.float32 and rgb.dtype == np.uint8


def test_depth_is_optional_and_holes_stay_holes():
    camera = camera_from_info(camera_info(D=PLUMB_BOB, model="plumb_bob"))
    rgb, depth = camera.rectify(np.zeros((48, 64, 3), np.uint8))
    assert rgb.shape == (48, 64, 3) and depth is None
    holes = np.full((48, 64), np.nan, np.float32)
    assert np.isnan(camera.rectify(rgb, holes)[1]).all()


def test_nothing_to_undo_returns_the_same_arrays():
    rgb, depth = np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32)
    for info in (camera_info(), camera_info(D=[0] * 5, model="plumb_bob"), camera_info(D=[0] * 8, model="")):
        camera = camera_from_info(info)
        got = camera.rectify(rgb, depth)
        assert got[0] is rgb and got[1] is depth
    assert "taken as none" in camera_from_info(camera_info()).decision
    assert "plumb_bob of zeros" in camera_from_info(camera_info(D=[0] * 5, model="plumb_bob")).decision


def test_tables_are_made_once_per_calibration():
    _tables.cache_clear()
    for _ in range(3):  # a new CameraInfo per frame, as drivers send it
        camera = camera_from_info(camera_info(D=PLUMB_BOB, model="plumb_bob"))
        camera.rectify(np.zeros((48, 64, 3), np.uint8))
    assert (_tables.cache_info().misses, _tables.cache_info().hits) == (1, 2)


@pytest.mark.parametrize("library", LIBRARIES)
def test_every_library_gives_the_same_camera(library):
    more = {"K": K, "P": P, "D": RATIONAL, "model": "rational_polynomial", "roi": (4, 4, 32, 32), "binning_x": 2}
    reference = camera_from_info(camera_info(**more))
    camera = camera_from_info(camera_info(library, **more))
    np.testing.assert_array_equal(camera.K, reference.K)
    assert (camera.coefficients, camera.decision) == (reference.coefficients, reference.decision)


GOOD = camera_info()
WITH_D = camera_info(D=PLUMB_BOB, model="plumb_bob")
TRANSPOSED = np.array(K.T.ravel())
MALFORMED = {
    "uncalibrated": (camera_info(K=np.zeros((3, 3))), {}, r"k\[0\] is 0: .*uncalibrated, calibrate it first"),
    "size never set": (camera_info(size=(0, 0)), {}, "camera_info is 0x0: .*uncalibrated"),
    "size too large": (camera_info(size=(9000, 48)), {}, "width is 9000"),
    "k too short": (changed(GOOD, k=[1.0] * 8), {}, "k has shape .8,.: expected 9 numbers"),
    "k nested": (changed(GOOD, k=K), {}, "k has shape .3, 3.: expected 9"),
    "k not numbers": (changed(GOOD, k="fx fy cx"), {}, "k is no sequence of numbers"),
    "k NaN": (changed(GOOD, k=[np.nan] * 9), {}, "k holds NaN or infinity"),
    "k infinite": (changed(GOOD, k=[np.inf] * 9), {}, "k holds NaN or infinity"),
    "k missing": (changed(GOOD, k=...), {}, "has no field 'k'"),
    "k transposed": (changed(GOOD, k=TRANSPOSED), {}, "is it transposed"),
    "k skewed": (changed(GOOD, k=[50.0, 1, 31, 0, 50, 23, 0, 0, 1]), {}, "expected .fx, 0, cx"),
    "k negative focal": (changed(GOOD, k=[-50.0, 0, 31, 0, 50, 23, 0, 0, 1]), {}, "focal lengths -50, 50"),
    "k without fy": (changed(GOOD, k=[50.0, 0, 31, 0, 0, 23, 0, 0, 1]), {}, "focal lengths 50, 0"),
    "p unset": (camera_info(P=np.zeros((3, 4))), {"rectified": "true"}, r"p\[0\] is 0: .*rectified:=false"),
    "p too short": (changed(GOOD, p=[1.0] * 9), {"rectified": "true"}, "p has shape .9,.: expected 12"),
    "p NaN": (changed(GOOD, p=[np.nan] * 12), {"rectified": "true"}, "p holds NaN"),
    "r too short": (changed(GOOD, r=[1.0] * 3), {"rectified": "true"}, "r has shape .3,.: expected 9"),
    "model unknown": (
        camera_info(D=[0.1] * 5, model="brown"),
        {},
        "distortion_model is 'brown': expected one of plumb",
    ),
    "model missing": (camera_info(D=[0.1] * 5), {}, "distortion_model is ''"),
    "model number": (changed(GOOD, distortion_model=1), {}, "distortion_model is int: expected text"),
    "d of 3": (camera_info(D=[0.1] * 3, model="plumb_bob"), {}, "d has 3 coefficients: expected 4 or 5 for plumb_bob"),
    "d empty": (camera_info(model="plumb_bob"), {}, "d has 0 coefficients: expected 4 or 5"),
    "d of 5 rational": (camera_info(D=[0.1] * 5, model="rational_polynomial"), {}, "expected 8 or 12 or 14"),
    "d of 5 fisheye": (camera_info(D=[0.1] * 5, model="fisheye"), {}, "expected 4 for fisheye"),
    "d NaN": (changed(WITH_D, d=[np.nan] * 5), {}, "d holds NaN"),
    "d missing": (changed(WITH_D, d=...), {}, "has no field 'd'"),
    "roi missing": (changed(GOOD, roi=...), {}, "has no field 'roi'"),
    "roi outside": (camera_info(roi=(40, 0, 40, 40)), {}, r"roi is 40x40 at \(40, 0\): expected it inside 64x48"),
    "roi below": (camera_info(roi=(0, 40, 40, 40)), {}, "expected it inside 64x48"),
    "roi half empty": (camera_info(roi=(0, 0, 32, 0)), {}, "roi is 32x0"),
    "roi offset alone": (camera_info(roi=(5, 5, 0, 0)), {}, "roi is 0x0 at"),
    "roi negative": (camera_info(roi=(-1, 0, 10, 10)), {}, "x_offset is -1"),
    "binning negative": (camera_info(binning_x=-2), {}, "binning_x is -2"),
    "binning huge": (camera_info(binning_y=65), {}, r"binning_y is 65: expected 0\.\.64"),
    "binning beyond the window": (camera_info(binning_y=50), {}, "binning is 1x50: expected less than the window"),
    "image of another shape": (GOOD, {"image_size": (64, 36)}, "another camera or a cropped image"),
    "image cropped, resizing allowed": (
        GOOD,
        {"image_size": (64, 36), "allow_resized": True},
        "image is 64x36 but camera_info describes 64x48",
    ),
    "image resized": (GOOD, {"image_size": (32, 24)}, "set allow_resized"),
    "image not binned": (
        camera_info(binning_x=2, binning_y=2),
        {"image_size": (64, 48)},
        "camera_info describes 32x24",
    ),
    "rectified misspelt": (GOOD, {"rectified": "yes"}, "rectified is 'yes': expected one of auto, true, false"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_camera_info_is_refused_by_name(name):
    info, more, expected = MALFORMED[name]
    with pytest.raises(MessageError, match=expected):
        camera_from_info(info, **more)


def test_images_of_another_size_are_not_rectified():
    camera = camera_from_info(GOOD)
    with pytest.raises(MessageError, match="image is 32x24: expected 64x48"):
        camera.rectify(np.zeros((24, 32, 3), np.uint8))
    with pytest.raises(MessageError, match=r"depth is 32x24: expected 64x48.*registered"):
        camera.rectify(np.zeros((48, 64, 3), np.uint8), np.zeros((24, 32), np.float32))
