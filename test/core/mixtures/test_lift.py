# SPDX-License-Identifier: Apache-2.0
"""A view lifted to Gaussians: on the surface, as large as the surface, as uncertain as the depth."""

import numpy as np
import pytest
import surfaces
from hypothesis import given, settings
from hypothesis import strategies as st
from surfaces import SIZE, K, grey_at, look

from garps_core import Config, View
from garps_core.config.lifting import Lifting
from garps_core.depth_errors import depth_sigma
from garps_core.geometry import pixel_rays, project
from garps_core.mixtures.frustum import FRUSTUM_STEP_PX
from garps_core.mixtures.reconstruct import reconstruct
from garps_core.objective.pairs import to_device, visible

UNSMOOTHED = Config().replace({"lifting.smoothing_px": 0})
VIEW = look()
NOISELESS = Config().replace({"lifting.noise_floor_m": 0.0, "lifting.noise_linear": 0.0})


def plane_view(slant_deg=40.0, range_m=2.5, turn_deg=30.0, zoom=1.0, size=SIZE):
    """View of an endless plane through (0, 0, range), and the plane's unit normal, towards the camera."""
    slant, turn = np.radians([slant_deg, turn_deg])
    normal = -np.array([np.sin(slant) * np.cos(turn), np.sin(slant) * np.sin(turn), np.cos(slant)])
    camera = K * [[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]]
    v, u = np.mgrid[: size[0], : size[1]].astype(float)
    depth = range_m * normal[2] / (pixel_rays(camera, u, v) @ normal)
    assert (depth > 0).all()
    return View(np.full((*size, 3), 100, np.uint8), camera, depth.astype(np.float32)), normal


def area_of(view, normal, range_m):
    """True area (m^2) of the part of the plane that the image shows, by the shoelace formula on its outline."""
    height, width = view.depth.shape
    u, v = np.array([-0.5, width - 0.5, width - 0.5, -0.5]), np.array([-0.5, -0.5, height - 0.5, height - 0.5])
    rays = pixel_rays(view.K, u, v)
    corners = rays * (range_m * normal[2] / (rays @ normal))[:, None]
    doubled = sum(np.cross(corners[i], corners[(i + 1) % 4]) for i in range(4))
    return 0.5 * np.linalg.norm(doubled @ normal)


@pytest.mark.parametrize("slant", [0, 20, 40])
def test_means_lie_on_the_plane(slant):
    view, normal = plane_view(slant)
    means = reconstruct(view, UNSMOOTHED).means
    assert np.abs((means - (0, 0, 2.5)) @ normal).max() < 1e-5
    smoothed = reconstruct(view).means
    assert (
        np.abs((smoothed - (0, 0, 2.5)) @ normal).max() < 0.02
        and np.median(np.abs((smoothed - (0, 0, 2.5)) @ normal)) < 1e-3
    )


def test_means_are_where_their_pixels_are():
    view = look()
    mixture = reconstruct(view, UNSMOOTHED)
    uv = project(view.K, mixture.means.astype(float))
    pixel = np.rint(uv).astype(int)
    np.testing.assert_allclose(uv, pixel, atol=1e-4)
    assert len(np.unique(pixel, axis=0)) == len(pixel) and set((pixel % 2).ravel()) == {1}
    np.testing.assert_allclose(mixture.means[:, 2], view.depth[pixel[:, 1], pixel[:, 0]])
    np.testing.assert_allclose(mixture.colours, view.rgb[pixel[:, 1], pixel[:, 0]] / 255, atol=1e-6)


def test_the_principal_point_counts():
    """The same image with another principal point is another direction, by the difference over the focal length."""
    camera = K.copy()
    camera[0, 2] += 14
    view = look()
    plain, shifted = reconstruct(view), reconstruct(View(view.rgb, camera, view.depth))
    moved = plain.means[:, 0] - plain.means[:, 2] * np.float32(0.1)
    np.testing.assert_allclose(shifted.means[:, 0], moved, atol=1e-6)
    np.testing.assert_array_equal(shifted.means[:, 1:], plain.means[:, 1:])


@pytest.mark.parametrize("slant", [0, 30, 55])
@pytest.mark.parametrize("stride", [1, 2, 4])
def test_footprint_lies_in_the_plane_and_is_as_wide_as_the_sampling(slant, stride):
    """Without depth noise a component is a flat ellipse; in the image its sigma is half the pixel spacing."""
    view, normal = plane_view(slant, zoom=2.0)
    mixture = reconstruct(view, NOISELESS.replace({"lifting.stride": stride, "lifting.smoothing_px": 0}))
    middle = np.flatnonzero((np.abs(mixture.means[:, :2]) < 0.5).all(axis=1))
    for i in middle[:: max(1, len(middle) // 20)]:
        S, p = mixture.covariances[i].astype(float), mixture.means[i].astype(float)
        values, vectors = np.linalg.eigh(S)
        assert abs(vectors[:, 0] @ normal) > 0.99 and values[0] < 0.02 * values[1]
        f = view.K[0, 0]
        J = np.array([[f, 0, -f * p[0] / p[2]], [0, f, -f * p[1] / p[2]]]) / p[2]
        np.testing.assert_allclose(J @ S @ J.T, np.eye(2) * (0.5 * stride) ** 2, atol=0.05 * stride**2 / 4)


@pytest.mark.parametrize(("smoothing_px", "readings"), [(0, 1), (5, 9)])
def test_sensor_noise_makes_a_component_thick_by_the_noise(smoothing_px, readings):
    """The noise of one reading, or of the mean of nine."""
    view, normal = plane_view(0)
    noise = {"noise_floor_m": 0.004, "noise_linear": 0.002, "noise_quadratic_per_m": 0.001}
    lifting = Lifting(**noise, smoothing_px=smoothing_px)
    mixture = reconstruct(view, Config(lifting=lifting))
    thickness = np.sqrt(np.einsum("i,nij,j->n", normal, mixture.covariances, normal))
    np.testing.assert_allclose(thickness, (0.004 + 0.002 * 2.5 + 0.001 * 2.5**2) / np.sqrt(readings), rtol=0.025)
    assert depth_sigma(np.float32(2.0), lifting) == pytest.approx(0.004 + 0.004 + 0.004)


def test_monocular_noise_is_2_mm_and_a_hundredth_of_the_depth_along_the_ray():
    """A third of a reading's. What whole maps get wrong is solved for; along the ray only the noise is counted."""
    mixture = reconstruct(look(), Config.preset("monocular"))
    rays = mixture.means.astype(float) / mixture.means[:, 2:]
    precision = np.einsum("ni,nij,nj->n", rays, np.linalg.inv(mixture.covariances.astype(float)), rays)
    np.testing.assert_allclose(precision**-0.5, 2e-3 + 0.01 * mixture.means[:, 2], rtol=2e-3)
    values, vectors = np.linalg.eigh(mixture.covariances.astype(float))
    reach = np.linalg.norm(mixture.means, axis=1)
    along = np.abs(np.einsum("ni,ni->n", vectors[:, :, 2], mixture.means)) / reach
    assert along.min() > 0.94 and np.median(values[:, 1] / values[:, 2]) < 0.4, "and it is their longest axis"


@pytest.mark.parametrize("slant", [0, 30, 50])
@pytest.mark.parametrize("range_m", [0.8, 4.0])
@pytest.mark.parametrize("stride", [1, 3])
def test_weights_add_up_to_the_area_seen(slant, range_m, stride):
    """Half a pixel at the border and pixels beyond the range limit are what the tolerance is for."""
    view, normal = plane_view(slant, range_m, zoom=1.3)
    lifting = {"lifting.stride": stride, "lifting.max_range_m": 1000.0, "lifting.edge_ratio": 1.0}
    mixture = reconstruct(view, UNSMOOTHED.replace(lifting))
    assert mixture.weights.sum() == pytest.approx(area_of(view, normal, range_m), rel=0.05)


def test_every_patch_of_a_plane_weighs_the_same_wherever_it_is_seen():
    """Local, not only in sum: halves of the image weigh as the areas they show."""
    view, normal = plane_view(40, turn_deg=0)
    mixture = reconstruct(view, UNSMOOTHED.replace({"lifting.edge_ratio": 1.0}))
    tangent = np.cross(normal, (0, 1, 0))
    where = np.stack([(mixture.means - (0, 0, 2.5)) @ tangent / np.linalg.norm(tangent), mixture.means[:, 1]], axis=1)
    inside = (np.abs(where) < (0.9, 0.9)).all(axis=1)
    cells = np.histogram2d(*where[inside].T, bins=3, range=[(-0.9, 0.9)] * 2, weights=mixture.weights[inside])[0]
    np.testing.assert_allclose(cells, 0.36, rtol=0.1)


def test_equal_weighting_gives_every_pixel_one():
    mixture = reconstruct(look(), Config().replace({"lifting.weighting": "equal"}))
    assert (mixture.weights == 1).all() and np.ptp(reconstruct(look()).weights) > 0


def test_surfaces_seen_flat_do_not_weigh_without_limit():
    view, _ = plane_view(70, turn_deg=0, zoom=10.0)
    bounded = reconstruct(view, UNSMOOTHED.replace({"lifting.min_cosine": 0.5, "lifting.edge_ratio": 1.0}))
    free = reconstruct(view, UNSMOOTHED.replace({"lifting.min_cosine": 0.01, "lifting.edge_ratio": 1.0}))
    np.testing.assert_allclose(free.weights / bounded.weights, 0.5 / np.cos(np.radians(70)), rtol=0.25)


def test_pixels_at_a_step_in_depth_are_dropped():
    depth = np.full(SIZE, 2.0, np.float32)
    depth[:, 80:] = 3.0
    mixture = reconstruct(View(np.zeros((*SIZE, 3), np.uint8), K, depth), Config().replace({"lifting.stride": 1}))
    column = np.rint(project(K, mixture.means.astype(float))[:, 0]).astype(int)
    assert set(range(160)) - set(column) == {79, 80}
    assert set(np.unique(mixture.means[:, 2])) == {2.0, 3.0}, "nothing in between"


def test_holes_stay_holes_and_their_borders_stay_on_the_surface():
    view, normal = plane_view(30)
    depth = view.depth.copy()
    depth[40:60, 50:90] = np.nan
    depth[70, 20] = 0
    mixture = reconstruct(View(view.rgb, K, depth), UNSMOOTHED.replace({"lifting.stride": 1}))
    row, column = np.rint(project(K, mixture.means.astype(float))).astype(int).T[::-1]
    assert not ((row >= 40) & (row < 60) & (column >= 50) & (column < 90)).any()
    assert len(mixture) == np.isfinite(view.depth).sum() - 20 * 40 - 1
    assert np.abs((mixture.means - (0, 0, 2.5)) @ normal).max() < 1e-5
    np.testing.assert_array_equal(np.linalg.eigvalsh(mixture.covariances.astype(float)).min(1) > 0, True)


def test_range_limits_are_kept():
    limits = Config().replace({"lifting.min_range_m": 2.3, "lifting.max_range_m": 2.6})
    z = reconstruct(look(), limits).means[:, 2]
    assert z.min() >= 2.29 and z.max() <= 2.61 and len(z) < 4800


@pytest.mark.parametrize("stride", [1, 2, 3, 5, 8])
def test_stride_takes_every_nth_pixel_both_ways(stride):
    mixture = reconstruct(look(), Config().replace({"lifting.stride": stride}))
    first = stride // 2
    assert len(mixture) == len(range(first, SIZE[0], stride)) * len(range(first, SIZE[1], stride))


def test_smoothing_takes_noise_away_and_keeps_the_step():
    """Readings within one sigma of each other are averaged: sensors are mostly better than their documented noise."""
    rng = np.random.default_rng(0)
    truth = np.where(np.arange(160) < 80, 2.0, 3.0) * np.ones(SIZE)
    noise = 0.3 * rng.normal(size=SIZE) * depth_sigma(truth.astype(np.float32), Lifting())
    view = View(np.zeros((*SIZE, 3), np.uint8), K, (truth + noise).astype(np.float32))

    def roughness(config):
        z = reconstruct(view, config).means[:, 2]
        return np.std(z - np.rint(z))

    assert roughness(Config()) < 0.5 * roughness(UNSMOOTHED)


def test_exact_depth_is_a_setting_like_any_other():
    """No noise at all: the filter's range kernel is then empty but for the pixel itself."""
    view, _ = plane_view(30)
    mixture = reconstruct(view, NOISELESS)
    np.testing.assert_array_equal(mixture.means, reconstruct(view, UNSMOOTHED).means)
    assert np.linalg.eigvalsh(mixture.covariances.astype(float)).min() > 0


@settings(max_examples=20)
@given(st.integers(2, 60))
def test_every_nth_component_is_an_even_sample(n):
    """Z-order: no pixel of the image is further from the subsample than a few times the subsample's own spacing."""
    uv = project(K, reconstruct(VIEW).means.astype(float))
    chosen = uv[::n]
    gap = np.sqrt(((uv[::23, None] - chosen[None]) ** 2).sum(-1)).min(1).max()
    assert gap < 2.5 * 2 * np.sqrt(n)


def test_a_mixture_is_float32_throughout():
    view = look()
    mixture = reconstruct(View(view.rgb, view.K, view.depth.astype(np.float64)))
    for name in ("means", "covariances", "weights", "colours"):
        assert getattr(mixture, name).dtype == np.float32, name
    assert mixture.frustum.depth.dtype == np.float32 and mixture.labels is None


@pytest.mark.parametrize("size", [(120, 160), (121, 163), (98, 130)])
def test_the_frustum_s_depth_map_lies_where_its_intrinsics_say(size):
    """Every cell, projected back through its own K and the image's, is the pixel whose depth it holds."""
    view = look(size=size)
    frustum = reconstruct(view, UNSMOOTHED).frustum
    v, u = np.mgrid[: frustum.depth.shape[0], : frustum.depth.shape[1]].astype(float)
    points = pixel_rays(frustum.K, u, v) * frustum.depth[..., None]
    pixel = project(view.K, points)
    expected = FRUSTUM_STEP_PX * np.stack([u, v], axis=-1) + FRUSTUM_STEP_PX // 2
    np.testing.assert_allclose(pixel, expected, atol=1e-3)
    row, column = expected[..., 1].astype(int), expected[..., 0].astype(int)
    np.testing.assert_array_equal(frustum.depth, view.depth[row, column])


@pytest.mark.parametrize("size", [(120, 160), (121, 163)])
def test_a_camera_sees_what_it_saw_and_nothing_behind_it(size):
    mixture = reconstruct(look(size=size))
    cloud = to_device(mixture, Config())
    assert visible(cloud, np.eye(4), mixture.frustum, 0.1).double().mean() > 0.98
    assert not visible(cloud, np.diag([-1.0, 1, -1, 1]), mixture.frustum, 0.1).any()
    nearer = np.eye(4)
    nearer[:3, :3] *= 0.7
    assert visible(cloud, nearer, mixture.frustum, 0.1).double().mean() > 0.98, "in front of the surface is seen"


def test_lifting_leaves_the_view_as_it_was():
    view = look(colours=grey_at)
    before = view.rgb.copy(), view.depth.copy(), view.K.copy()
    reconstruct(view)
    for old, new in zip(before, (view.rgb, view.depth, view.K), strict=True):
        np.testing.assert_array_equal(old, new)


def test_the_wavy_surface_lies_within_its_own_bounds():
    z = reconstruct(look(), UNSMOOTHED).means[:, 2]
    x, y = np.meshgrid(*[np.linspace(-2, 2, 200)] * 2)
    heights = surfaces.height(x, y)
    assert heights.min() - 1e-3 <= z.min() and z.max() <= heights.max() + 1e-3
