# SPDX-License-Identifier: Apache-2.0
"""Parts that other distributions add by entry points: listed without loading them, loaded with errors that name them.

A distribution adds one with `NAME = "package.module:object"` in its entry point group (`docs/extending.md`).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from garps_core.errors import ConfigError, GarpsError


def installed(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name, sorted. Nothing is imported; the first on the path wins a name."""
    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=group):
        found.setdefault(point.name, point)
    return dict(sorted(found.items()))


def installed_besides(group: str, taken: frozenset[str]) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name, without the names that mean something else already.

    They are kept for this `sys.path`; settings are made too often to look there every time.
    """
    return _installed_besides(group, taken, tuple(sys.path))


@lru_cache(maxsize=8)
def _installed_besides(group: str, taken: frozenset[str], path: tuple[str, ...]) -> dict[str, EntryPoint]:
    return {name: point for name, point in installed(group).items() if name not in taken}


def told(point: EntryPoint) -> str:
    """Return the name of an entry point with its origin, for errors: "'name' (module:object of distribution 1.0)"."""
    of = f" of {point.dist.name} {point.dist.version}" if point.dist else ""
    return f"{point.name!r} ({point.value}{of})"


def origin(point: EntryPoint | None) -> str:
    """Return the distribution of an entry point, for lists; "" where it is not known."""
    return f"installed by {point.dist.name} {point.dist.version}" if point and point.dist else ""


def load(group: str, name: str, what: str, page: str = "docs/extending.md") -> Any:
    """Import the object that an installed distribution offers under a name.

    Args:
        group: the entry point group, e.g. "garps_core.two_view".
        name: the entry point.
        what: the kind of thing, for errors, e.g. "adapter".
        page: the document that shows how to write one.
    Raises:
        ConfigError: no such name is installed, or its import fails.
    """
    there = installed(group)
    if name not in there:
        known = f"one of {', '.join(there)}" if there else "an installed one, and there is none"
        raise ConfigError(f"{what} {name!r} is not installed: expected {known}. See {page} for how to write one.")
    with foreign(f"the {what} {name!r} ({there[name].value}) cannot be loaded", ConfigError):
        return there[name].load()


@contextmanager
def foreign(failure: str, error: type[GarpsError]) -> Iterator[None]:
    """Run somebody else's code: errors of GARPS pass, any other exception becomes `error`, "failure: Class: text"."""
    try:
        yield
    except GarpsError:
        raise
    except Exception as raised:
        raise error(f"{failure}: {type(raised).__name__}: {raised}") from raised
