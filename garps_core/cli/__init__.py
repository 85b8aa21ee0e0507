# SPDX-License-Identifier: Apache-2.0
"""The command `garps`. `command.py` lists its subcommands; nothing is loaded before one of them runs."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command with the given words, by default those of the command line; returns its exit code."""
    from garps_core.cli.command import main as run

    return run(arguments)
