# SPDX-License-Identifier: Apache-2.0
"""The command `garps`. Its subcommands are in `command.py`, which is loaded when one of them runs."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command with the given words, by default those of the command line, and return its exit code."""
    from garps_core.cli.command import main as run

    return run(arguments)
