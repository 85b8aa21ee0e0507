# SPDX-License-Identifier: Apache-2.0
"""Before/after picture of an alignment: source in yellow, target in blue, green where their surfaces coincide.

No other file imports matplotlib, and this one only when it draws. The points are splatted with numpy, because 3D
scatter plots sort whole artists instead of points, and so hide points that should be visible.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from garps_core.checks import checked_rigid
from garps_core.errors import InputError
from garps_core.geometry import Array, transform
from garps_core.types import Mixture

YELLOW = np.array([242, 178, 0]) / 255
BLUE = np.array([38, 92, 214]) / 255
GREEN = np.array([38, 160, 84]) / 255
PANEL = (900, 640)
"""Width and height of a rendered view, px."""

LABEL: dict[str, Any] = {"fontsize": 11, "ha": "right", "bbox": {"facecolor": "white", "edgecolor": "0.7", "pad": 4}}

Image = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Eye:
    """A virtual pinhole camera.

    Args:
        T_eye_target: 4x4, maps points of the target camera into the eye, m.
        focal: focal length, px.
        centre: principal point x and y in the panel, px.
    """

    T_eye_target: Array
    focal: float
    centre: Array


def before_after(
    source: Mixture, target: Mixture, T_before: Any, T_after: Any, path: str | Path, title: str = ""
) -> Path:
    """Draw source and target under two poses, side by side, seen from behind the target camera and from above.

    Args:
        source, target: mixtures in the frames of their cameras.
        T_before, T_after: 4x4 T_target_source, metres.
        path: a .png file, or another format that matplotlib writes.
        title: one line above the panels.
    Returns:
        The path.
    Raises:
        InputError: matplotlib is missing, a mixture is empty, a pose is no rigid motion, or the file cannot be written.
    """
    poses = [checked_rigid("T_before", T_before), checked_rigid("T_after", T_after)]
    if not len(source) or not len(target):
        raise InputError("a mixture is empty: expected components to draw in both")
    panels = _panels(source, target, poses)
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError("pictures need matplotlib, which is not installed. Run: pip install matplotlib") from None
    figure = Figure(figsize=(12.4, 9.6), dpi=110, facecolor="white")
    FigureCanvasAgg(figure)
    _compose(figure, panels, poses, title)
    try:
        figure.savefig(str(path))
    except (OSError, ValueError) as error:
        raise InputError(f"cannot write {path} ({error}): expected a writable file name ending in .png") from None
    return Path(path)


@dataclass(frozen=True)
class _Panels:
    oblique: list[tuple[Image, float]]
    above: list[Image]
    extent: tuple[float, float, float, float]
    """Left, right, bottom and top of the plan view: x and z of the target camera, m."""


def _panels(source: Mixture, target: Mixture, poses: list[Array]) -> _Panels:
    target_points = np.asarray(target.means, float)
    placed = [transform(T, np.asarray(source.means, float)) for T in poses]
    shades = [_shade(source), _shade(target)]
    eye = _viewpoint(target_points, placed)
    oblique = [_oblique(eye, [points, target_points], shades) for points in placed]
    extent = _plan_extent([*placed, target_points], poses)
    above = [_plan([points, target_points], extent) for points in placed]
    return _Panels(oblique, above, extent)


def _shade(mixture: Mixture) -> Array:
    """Return a brightness of 0.45..1 per component, so that the room stays recognisable under one tint."""
    grey = np.asarray(mixture.colours, float) @ (0.299, 0.587, 0.114)
    low, high = np.percentile(grey, (2, 98))
    return np.asarray(0.45 + 0.55 * np.clip((grey - low) / max(high - low, 1e-3), 0, 1))


def _viewpoint(target: Array, placed: list[Array]) -> Eye:
    """Return an eye behind, above and to the right of the target camera, which looks at the middle of its points."""
    centre = np.median(target, axis=0)
    reach = float(np.linalg.norm(centre))
    position = np.array([0.35, -0.5, -0.3]) * reach
    forward = (centre - position) / np.linalg.norm(centre - position)
    right = np.cross((0.0, 1.0, 0.0), forward)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    T[:3, 3] = -T[:3, :3] @ position
    seen = transform(T, np.concatenate([target, *placed]))
    seen = seen[seen[:, 2] > 0.2 * reach]
    low, high = np.percentile(seen[:, :2] / seen[:, 2:], (3, 97), axis=0)
    focal = 0.92 * float(np.min(np.array(PANEL) / np.maximum(high - low, 1e-3)))
    return Eye(T, focal, np.array(PANEL) / 2 - focal * (low + high) / 2)


def _oblique(eye: Eye, clouds: list[Array], shades: list[Array]) -> tuple[Image, float]:
    """Render both clouds through one eye: the nearer point wins, green where the two agree to 1.5 % of the range.

    Returns:
        The image (height, width, 3), and the share of the pixels covered by both in which they agree.
    """
    (depth_s, shade_s), (depth_t, shade_t) = (
        _splat(eye, cloud, shade) for cloud, shade in zip(clouds, shades, strict=True)
    )
    nearest = np.minimum(depth_s, depth_t)
    covered = np.isfinite(depth_s) & np.isfinite(depth_t)
    with np.errstate(invalid="ignore"):
        both = covered & (np.abs(depth_s - depth_t) < 0.015 * nearest)
    agreement = float(both.sum() / max(covered.sum(), 1))
    front = depth_s < depth_t
    tint = np.where(both[..., None], GREEN, np.where(front[..., None], YELLOW, BLUE))
    shade = np.where(both, 0.5 * (shade_s + shade_t), np.where(front, shade_s, shade_t))
    return np.where(np.isfinite(nearest)[..., None], tint * shade[..., None], 1.0), agreement


def _splat(eye: Eye, points: Array, shade: Array, radius: int = 2) -> tuple[Image, Image]:
    """Draw square splats with a depth test. Returns depth (inf = nothing) and brightness, each PANEL height x width."""
    width, height = PANEL
    seen = transform(eye.T_eye_target, points)
    keep = seen[:, 2] > 0.05 * np.median(np.abs(seen[:, 2]))
    seen, shade = seen[keep], shade[keep]
    columns = np.rint(eye.focal * seen[:, 0] / seen[:, 2] + eye.centre[0]).astype(int)
    rows = np.rint(eye.focal * seen[:, 1] / seen[:, 2] + eye.centre[1]).astype(int)
    order = np.argsort(-seen[:, 2], kind="stable")  # far first: the last one written stays
    depth, bright = np.full((height, width), np.inf), np.zeros((height, width))
    offsets = [(dr, dc) for dr in range(-radius, radius + 1) for dc in range(-radius, radius + 1)]
    for dr, dc in sorted(offsets, key=lambda o: -(o[0] ** 2 + o[1] ** 2)):
        r, c = rows[order] + dr, columns[order] + dc
        inside = (r >= 0) & (r < height) & (c >= 0) & (c < width)
        r, c, i = r[inside], c[inside], order[inside]
        layer, layer_bright = np.full_like(depth, np.inf), np.zeros_like(bright)
        layer[r, c], layer_bright[r, c] = seen[i, 2], shade[i]
        closer = layer < depth * 0.995  # a neighbour's splat only fills holes and hides what is clearly behind
        depth[closer], bright[closer] = layer[closer], layer_bright[closer]
    return depth, bright


def _plan_extent(clouds: list[Array], poses: list[Array]) -> tuple[float, float, float, float]:
    """Return bounds of the plan view, m, in the shape of a panel: they hold all cameras and nearly all points."""
    low, high = np.percentile(np.concatenate(clouds)[:, [0, 2]], (3, 97), axis=0)
    cameras = np.array([[0.0, 0.0], *(T[[0, 2], 3] for T in poses)])
    low, high = np.minimum(low, cameras.min(0)) - 0.15, np.maximum(high, cameras.max(0)) + 0.15
    centre, half = (low + high) / 2, (high - low) / 2
    half = np.maximum(half, half[::-1] * (PANEL[0] / PANEL[1], PANEL[1] / PANEL[0]))
    return (
        float(centre[0] - half[0]),
        float(centre[0] + half[0]),
        float(centre[1] - half[1]),
        float(centre[1] + half[1]),
    )


def _plan(clouds: list[Array], extent: tuple[float, float, float, float]) -> Image:
    """Draw the view from above as ink: upright surfaces become dark lines, green where both clouds leave ink."""
    width, height = PANEL[0] // 3, PANEL[1] // 3
    amounts = []
    for points in clouds:
        counts, _, _ = np.histogram2d(points[:, 2], points[:, 0], bins=(height, width), range=[extent[2:], extent[:2]])
        drops = gaussian_filter(counts, 0.7)
        filled = drops[drops > 0.1]
        amounts.append(1 - np.exp(-1.5 * drops / (np.percentile(filled, 70) if len(filled) else 1.0)))
    both = np.minimum(*amounts)
    inks = (both, GREEN), (amounts[0] - both, YELLOW), (amounts[1] - both, BLUE)
    return np.asarray(1.0 - sum(amount[..., None] * (1 - ink) for amount, ink in inks))


def _compose(figure: Any, panels: _Panels, poses: list[Array], title: str) -> None:
    axes = figure.subplots(2, 2, gridspec_kw={"height_ratios": [1, 1]})
    figure.subplots_adjust(left=0.055, right=0.985, top=0.875, bottom=0.055, wspace=0.08, hspace=0.1)
    for column, (name, T) in enumerate(zip(("start", "aligned"), poses, strict=True)):
        top, bottom = axes[0][column], axes[1][column]
        image, agreement = panels.oblique[column]
        top.imshow(image, interpolation="antialiased")
        top.text(0.985, 0.03, f"{100 * agreement:.0f} % of the shared view agrees", transform=top.transAxes, **LABEL)
        top.set_title(f"{name}:  {_motion(T)}", fontsize=13, fontweight="bold")
        top.set_xticks([])
        top.set_yticks([])
        bottom.imshow(panels.above[column], origin="lower", extent=panels.extent, interpolation="bilinear")
        _draw_camera(bottom, np.eye(4), BLUE, panels.extent)
        _draw_camera(bottom, T, YELLOW, panels.extent)
        bottom.set_xlabel("x [m]", labelpad=1)
        bottom.grid(alpha=0.25, linewidth=0.5)
    axes[0][0].set_ylabel("from behind and above the target camera")
    axes[1][0].set_ylabel("from above: z [m]")
    figure.suptitle(title or "Relative pose by mixture alignment", x=0.055, y=0.985, ha="left", fontsize=14)
    for x, (colour, text) in zip(
        (0.055, 0.20, 0.35),
        ((YELLOW, "source"), (BLUE, "target"), (GREEN, "both, at one place")),
        strict=True,
    ):
        figure.text(x, 0.925, "\u25a0", color=colour, fontsize=17, va="center")
        figure.text(x + 0.018, 0.926, text, fontsize=12, va="center")


def _motion(T: Array) -> str:
    cosine = np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)
    return f"|t| = {np.linalg.norm(T[:3, 3]):.3f} m,  {np.degrees(np.arccos(cosine)):.1f}\u00b0"


def _draw_camera(axes: Any, T: Array, colour: Array, extent: tuple[float, float, float, float]) -> None:
    """Draw a wedge in the plan view, with its tip at the camera's centre, open in the direction of view."""
    size = 0.06 * (extent[3] - extent[2])
    wedge = transform(T, np.array([[0.0, 0, 0], [-0.6, 0, 1], [0.6, 0, 1], [0.0, 0, 0]]) * size)
    axes.fill(wedge[:, 0], wedge[:, 2], facecolor=colour, edgecolor="black", linewidth=0.8, zorder=5)
