# SPDX-License-Identifier: Apache-2.0
"""Distributions that are installed for a test only, without pip: their metadata in a folder on the path."""

from pathlib import Path


def write_distribution(folder: Path, name: str, group: str, entries: dict[str, str]) -> Path:
    """Write what `pip install` leaves of a distribution with entry points NAME = package.module:object; the folder."""
    place = folder / f"{name}-1.0.dist-info"
    place.mkdir(parents=True)
    (place / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
    lines = [f"[{group}]", *(f"{key} = {value}" for key, value in entries.items()), ""]
    (place / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")
    return folder
