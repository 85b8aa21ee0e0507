# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of the pairing: visibility, exact nearest neighbours, and the gathering of partners.

Neighbours are searched with the partners sorted into cells of the image they came from. That is faster than a k-d tree:
a surface seen by a camera is nearly flat in the image, so the neighbours of a point lie in the cells around its pixel.
`compiled.py` calls these loops, and falls back on SciPy's tree.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from garps_core.objective.loops import Float32, Int64, loop

NEAREST_M = 1e-3
"""Points nearer than this, or behind the camera, have no place in its image, m."""
PER_CELL = 2.0
"""Partners in a cell, on average."""
MOST_ROWS = 40_000
"""With more rows the tree is faster: a row without a partner nearby looks through all the cells around it, and they
are the more, the denser the partners."""


@loop
def nearest(rows: Float32, partners: Float32, k: int) -> tuple[Int64, Float32]:
    """The k nearest partners of each row, exact: indices (n, k) by distance, and distances (n, k).

    rows (n, 3), partners (m, 3), in the same frame, partners in front of the camera. Partners are sorted into
    cells of the image; rings of cells around a row's pixel are searched until no cell beyond them can hold a nearer
    one: whatever lies beyond a line x = a z of the image is at least |x - a z| / sqrt(1 + a^2) away.
    """
    n, m = len(rows), len(partners)
    slopes = np.empty((m, 2), np.float32)
    for i in range(m):
        for axis in range(2):
            slopes[i, axis] = partners[i, axis] / partners[i, 2]
    low_x, low_y = slopes[:, 0].min(), slopes[:, 1].min()
    span_x, span_y = slopes[:, 0].max() - low_x + 1e-6, slopes[:, 1].max() - low_y + 1e-6
    cell = np.sqrt(span_x * span_y * PER_CELL / m)
    cell = max(cell, span_x / 1024, span_y / 1024)
    across, down = int(span_x / cell) + 1, int(span_y / cell) + 1
    first, order = _sorted_into_cells(slopes, low_x, low_y, cell, across, down)
    points = np.empty((m, 3), np.float32)
    for i in range(m):
        p = partners[order[i]]
        points[i, 0], points[i, 1], points[i, 2] = p[0], p[1], p[2]
    grid = (low_x, low_y, cell, across, down)
    index, distance = np.empty((n, k), np.int64), np.empty((n, k), np.float32)
    best, where = np.empty(k, np.float32), np.empty(k, np.int64)
    for i in range(n):
        x, y, z = rows[i, 0], rows[i, 1], rows[i, 2]
        safe = max(z, np.float32(NEAREST_M))
        _search_rings(x, y, z, x / safe, y / safe, points, first, grid, best, where)
        for j in range(k):
            index[i, j], distance[i, j] = order[where[j]], np.sqrt(best[j])
    return index, distance


@loop
def _search_rings(
    x: float, y: float, z: float, slope_x: float, slope_y: float, points: Float32, first: Int64,
    grid: tuple[float, float, float, int, int], best: Float32, where: Int64,
) -> None:  # fmt: skip
    """Fill `best` (squared distances, sorted) and `where` with the nearest points of (x, y, z)."""
    low_x, low_y, cell, across, down = grid
    column = min(max(int((slope_x - low_x) / cell), 0), across - 1)
    row = min(max(int((slope_y - low_y) / cell), 0), down - 1)
    best[:] = np.inf
    where[:] = 0
    ring = 0
    while True:
        for v in range(max(row - ring, 0), min(row + ring, down - 1) + 1):
            step = 1 if abs(v - row) == ring else max(2 * ring, 1)
            for u in range(column - ring, column + ring + 1, step):
                if u >= 0 and u < across:
                    _keep_nearest(x, y, z, points, first[v * across + u], first[v * across + u + 1], best, where)
        bound = np.inf
        if column - ring > 0:
            line = low_x + (column - ring) * cell
            bound = min(bound, _beyond(slope_x - line, line, z))
        if column + ring + 1 < across:
            line = low_x + (column + ring + 1) * cell
            bound = min(bound, _beyond(line - slope_x, line, z))
        if row - ring > 0:
            line = low_y + (row - ring) * cell
            bound = min(bound, _beyond(slope_y - line, line, z))
        if row + ring + 1 < down:
            line = low_y + (row + ring + 1) * cell
            bound = min(bound, _beyond(line - slope_y, line, z))
        if bound == np.inf or bound * bound > best[-1]:
            return
        ring += 1


@loop
def _keep_nearest(
    x: float, y: float, z: float, points: Float32, begin: int, end: int, best: Float32, where: Int64
) -> None:
    """Insert the points of one cell that are nearer than the farthest kept so far."""
    last = len(best) - 1
    for p in range(begin, end):
        d0, d1, d2 = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
        d = d0 * d0 + d1 * d1 + d2 * d2
        if d < best[last]:
            place = last
            while place > 0 and best[place - 1] > d:
                best[place], where[place] = best[place - 1], where[place - 1]
                place -= 1
            best[place], where[place] = d, p


@loop
def _beyond(gap: float, line: float, z: float) -> float:
    """Distance from a row to all that lies beyond a line of the image, `gap` slopes away; 0 when nothing is known."""
    if gap <= 0 or z <= NEAREST_M:
        return 0.0
    return float(gap * z / np.sqrt(1 + line * line))


@loop
def _sorted_into_cells(
    slopes: Float32, low_x: float, low_y: float, cell: float, across: int, down: int
) -> tuple[Int64, Int64]:
    """First position of every cell (cells + 1,), and the partners in order of their cells (m,)."""
    m = len(slopes)
    of, first = np.empty(m, np.int64), np.zeros(across * down + 1, np.int64)
    for i in range(m):
        u = min(int((slopes[i, 0] - low_x) / cell), across - 1)
        v = min(int((slopes[i, 1] - low_y) / cell), down - 1)
        of[i] = v * across + u
        first[of[i] + 1] += 1
    for i in range(across * down):
        first[i + 1] += first[i]
    place, order = first.copy(), np.empty(m, np.int64)
    for i in range(m):
        order[place[of[i]]] = i
        place[of[i]] += 1
    return first, order


@loop
def gathered(
    index: Int64, means: Float32, covariances: Float32, log_weights: Float32, colours: Float32, row_colours: Float32,
    per_colour: float,
) -> tuple[Float32, Float32, Float32]:  # fmt: skip
    """Partners' means (3, k, n), covariances (6, k, n) and log weights less colour cost (k, n); index (n, k)."""
    n, k = index.shape
    y, S = np.empty((3, k, n), np.float32), np.empty((6, k, n), np.float32)
    weights = np.empty((k, n), np.float32)
    cost = np.float32(per_colour)
    for i in range(n):
        for j in range(k):
            p = index[i, j]
            for axis in range(3):
                y[axis, j, i] = means[p, axis]
            for element in range(6):
                S[element, j, i] = covariances[p, element]
            red = row_colours[i, 0] - colours[p, 0]
            green = row_colours[i, 1] - colours[p, 1]
            blue = row_colours[i, 2] - colours[p, 2]
            weights[j, i] = log_weights[p] - cost * (red * red + green * green + blue * blue)
    return y, S, weights


@loop
def visible(points: Float32, R: Float32, t: Float32, K: Float32, depth: Float32, ratio: float) -> npt.NDArray[np.bool_]:
    """Mask (n,) of points (n, 3) that the other camera sees (`plain.visible`)."""
    height, width = depth.shape
    mask = np.zeros(len(points), np.bool_)
    reach = np.float32(1 + ratio)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        forward = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        if forward > np.float32(NEAREST_M):
            u = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) / forward * K[0, 0] + K[0, 2]
            v = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) / forward * K[1, 1] + K[1, 2]
            if u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5:
                mask[i] = not (forward > depth[int(np.rint(v)), int(np.rint(u))] * reach)
    return mask
