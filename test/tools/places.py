# SPDX-License-Identifier: Apache-2.0
"""Folders that tests need: the checkout, and the recordings beside it, which are not committed."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
GOLDEN = ROOT / "test" / "golden"
