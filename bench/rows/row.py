# SPDX-License-Identifier: Apache-2.0
"""A row: the result of one method on one pair with one depth from one start."""

from __future__ import annotations

from typing import Any

Row = dict[str, Any]
GARPS = "garps"
START = "(start)"
"""The row of the pose before the alignment."""
ERRORS = ("e_trans_m", "e_rot_deg", "e_3d_m", "e_c_m", "vcre_px")
"""Errors that are infinite where there is no pose."""
