# SPDX-License-Identifier: Apache-2.0
"""Old names of settings, and old words for their values; they work for one release, with a warning."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

LOG = logging.getLogger("garps_core")


@dataclass(frozen=True)
class Renamed:
    """A setting of another name: the old one, the new one, and new words for old values where these changed too."""

    old: str
    new: str
    values: Mapping[str, str] = field(default_factory=dict)


RENAMED = (
    Renamed("alignment.information", "alignment.effective_measurements"),
    Renamed("alignment.brightness", "alignment.brightness_measurements"),
    Renamed("alignment.solver", "method", {"adam": "paper", "second_order": "garps"}),
    Renamed("alignment.component_stride", "paper.component_stride"),
    Renamed("alignment.opacity_threshold", "paper.opacity_threshold"),
    Renamed("alignment.adam_rate_translation", "paper.rate_translation"),
    Renamed("alignment.adam_rate_rotation", "paper.rate_rotation"),
)
"""Table of old names, one line each; a line is deleted after one release."""


def current(name: str, value: Any) -> tuple[str, Any]:
    """Return name and value as they are called now. The first use of an old name is a warning in the log."""
    for renamed in RENAMED:
        if renamed.old == name:
            new = renamed.values.get(value, value) if isinstance(value, str) else value
            warn_once(_called(name, value, new), _called(renamed.new, new, value))
            return renamed.new, new
    return name, value


def _called(name: str, value: Any, other: Any) -> str:
    return name if value == other else f"{name}={value}"


@cache
def warn_once(old: str, new: str) -> None:
    """Log a warning that a setting has a new name; a second call with the same names does nothing."""
    LOG.warning(f"{old} is now called {new}: expected the new name. The old one works in this release only")
