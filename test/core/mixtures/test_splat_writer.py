# SPDX-License-Identifier: Apache-2.0
"""The splat file, read again by an independent reader."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from random_splats import random_mixture

from garps_core.errors import InputError
from garps_core.mixtures.splat_writer import FIELDS, SH_CONSTANT, splat_table, write_splats
from garps_core.types import Mixture


def rebuilt_covariances(vertex: np.ndarray) -> np.ndarray:
    """scale and rot -> R S S^T R^T, as the viewers' shaders do, written out without scipy."""
    w, x, y, z = (vertex[f"rot_{i}"].astype(float) for i in range(4))
    norm = np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    R = np.empty((len(w), 3, 3))
    R[:, 0] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1)
    R[:, 1] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1)
    R[:, 2] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1)
    M = R * np.exp(np.stack([vertex[f"scale_{i}"] for i in range(3)], 1).astype(float))[:, None, :]
    return M @ M.transpose(0, 2, 1)


def test_an_independent_reader_finds_the_same_mixture(tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile")
    mixture = random_mixture(500)
    ply = plyfile.PlyData.read(str(write_splats(mixture, tmp_path / "mixture.ply")))
    vertex = ply["vertex"].data
    assert not ply.text
    assert ply.byte_order == "<"
    assert vertex.dtype.names == FIELDS
    assert len(vertex) == 500
    np.testing.assert_allclose(np.stack([vertex[a] for a in "xyz"], 1), mixture.means, atol=1e-6)
    colours = 0.5 + SH_CONSTANT * np.stack([vertex[f"f_dc_{i}"] for i in range(3)], 1)
    np.testing.assert_allclose(colours, mixture.colours, atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-vertex["opacity"])), 0.95, atol=1e-6)
    again = rebuilt_covariances(vertex)
    size = np.linalg.norm(mixture.covariances, axis=(1, 2))
    assert (np.linalg.norm(again - mixture.covariances, axis=(1, 2)) / size).max() < 1e-4


def test_flat_components_keep_their_thin_side() -> None:
    """A pixel of a far wall: 5 cm wide, 0.1 mm thick, seen at an angle."""
    axis = np.array([0.6, 0.0, 0.8])
    covariance = 0.05**2 * (np.eye(3) - np.outer(axis, axis)) + 1e-4**2 * np.outer(axis, axis)
    mixture = Mixture(np.zeros((1, 3)), covariance[None], np.ones(1), np.full((1, 3), 0.5))
    row = splat_table(mixture)[0]
    names = list(FIELDS)
    np.testing.assert_allclose(np.exp(row[names.index("scale_0")]), 1e-4, rtol=1e-3)
    np.testing.assert_allclose(np.exp(row[names.index("scale_2")]), 0.05, rtol=1e-5)
    assert np.isfinite(row).all()


def test_given_opacities_are_stored_as_logits() -> None:
    given = np.array([0.0, 0.25, 1.0])
    stored = splat_table(random_mixture(3), given)[:, FIELDS.index("opacity")]
    np.testing.assert_allclose(1 / (1 + np.exp(-stored)), given, atol=2e-4)
    assert np.isfinite(stored).all()


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="empty"):
        write_splats(random_mixture(1).subset(np.zeros(1, bool)), tmp_path / "a.ply")
    with pytest.raises(InputError, match="cannot write"):
        write_splats(random_mixture(1), tmp_path / "no_such_folder" / "a.ply")
    with pytest.raises(InputError, match="opacities"):
        splat_table(random_mixture(2), np.array([0.5, 1.5]))
