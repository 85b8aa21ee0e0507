# SPDX-License-Identifier: Apache-2.0
"""`bench.run` called as from the shell."""

from __future__ import annotations

import typer
from typer.testing import CliRunner

from bench import run


def called(*words: str) -> tuple[int, str]:
    app = typer.Typer()
    app.command()(run.main)
    found = CliRunner().invoke(app, [str(word) for word in words])
    assert found.exception is None or isinstance(found.exception, SystemExit), found.exception
    return found.exit_code, found.output
