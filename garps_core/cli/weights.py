# SPDX-License-Identifier: Apache-2.0
"""`garps weights`: list, fetch, verify, convert and check the files of the networks."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from garps_core.errors import WeightsError
from garps_core.weights.manifest import ALL
from garps_core.weights.store import installed, weights_folder

app = typer.Typer(help="Weights of the networks: list, fetch, verify, convert, check.", rich_markup_mode=None)

Name = Annotated[str, typer.Argument(help="As in `garps weights list`.", metavar="NAME")]
File = Annotated[Path, typer.Argument(help="A torch (.pth) or safetensors file.", metavar="FILE")]
Kind = Annotated[
    str | None, typer.Option(help="The network, for a renamed MASt3R or DUSt3R .pth file: mast3r, dust3r.")
]
Variant = Annotated[
    str, typer.Option(help="indoor (20 m) or outdoor (80 m): Depth Anything's files do not tell.", metavar="VARIANT")
]


@app.callback(invoke_without_command=True)
def _root(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit(2)


@app.command("list")
def list_() -> int:
    """All files that GARPS can use, with licence."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for title in ("name", "installed", "MB", "licence", "for"):
        table.add_column(title, justify="right" if title == "MB" else "left", no_wrap=True)
    for weights in ALL:
        path = installed(weights.name)
        size = f"{path.stat().st_size / 1e6:.1f}" if path else f"< {weights.bytes_bound / 1e6:.0f}"
        licence = weights.licence.split(",")[0].split(" and ")[0] + (" *" if weights.needs_acceptance else "")
        table.add_row(weights.name, "yes" if path else "-", size, licence, weights.what)
    Console(width=None if sys.stdout.isatty() else 160).print(table)
    print(f"\nfolder: {weights_folder()}   (* not permissive: needs --accept-licence NAME)")
    return 0


@app.command()
def fetch(
    name: Name,
    accept_licence: Annotated[
        str | None, typer.Option(help="The same name again: you have read its licence and may use it.", metavar="NAME")
    ] = None,
) -> int:
    """Download a file from the hub into the weights folder.

    HF_ENDPOINT names another hub, GARPS_WEIGHTS another folder. Prints the licence first. Nothing else in GARPS uses
    the network, and nothing is ever fetched by itself.
    """
    from garps_core.weights.fetch import fetch as fetched

    fetched(name, accept_licence)
    return 0


@app.command()
def verify(
    name: Annotated[str | None, typer.Argument(help="One name. [all installed]", metavar="[NAME]")] = None,
) -> int:
    """Check installed files; record what is new.

    The checksums of files seen for the first time are recorded in the folder, and compared from then on.

    \b
    Exit code: 0 = all as they should be, 1 = at least one is not, or none is installed.
    """
    from garps_core.weights.verify import verify as verified

    names = [name] if name else [weights.name for weights in ALL if installed(weights.name)]
    if not names:
        print(f"no weights in {weights_folder()}; `garps weights list` shows what there is")
    failed = not names
    for one in names:
        try:
            print(f"{one}: {verified(one)}")
        except WeightsError as error:
            failed = True
            print(f"{one}: FAILED: {error}")
    return 1 if failed else 0


@app.command()
def convert(
    source: File,
    target: Annotated[Path, typer.Argument(help="A new .safetensors file.", metavar="OUT.safetensors")],
    variant: Variant = "",
    kind: Kind = None,
) -> int:
    """Write the needed tensors as safetensors.

    Source, licence, variant and range go with them.
    A checkpoint of the relative Depth Anything cannot be told from a metric one: take the authors' metric files.
    """
    from garps_core.models.convert import convert as converted

    done = converted(source, target, variant=variant, kind=kind)
    for group, count in sorted(done.left.items()):
        print(f"left out: {count} tensors of {group}")
    print(f"{target}: {done.kept} tensors, {done.bytes / 1e6:.1f} MB; licence as before: {done.licence}")
    return 0


@app.command()
def check(file: File, variant: Variant = "", kind: Kind = None) -> int:
    """Check whether a weights file is plausible.

    Looks at all tensors and sends one drawn picture through the network.

    \b
    Exit code: 0 = all is plausible, 1 = something is not.
    """
    from garps_core.models.check import check_file

    healthy = True
    for name, result, good in check_file(file, variant=variant, kind=kind):
        healthy = healthy and good
        print(f"{name:<11} {result}" + ("" if good else "   <- NOT PLAUSIBLE"))
    return 0 if healthy else 1
