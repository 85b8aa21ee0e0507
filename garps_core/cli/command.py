# SPDX-License-Identifier: Apache-2.0
"""The `garps` command: parse, call the core, print. Exit code 0 = a pose to use, 1 = none, 2 = wrong input."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.spatial.transform import Rotation

from garps_core.align import Estimator, align_mixtures
from garps_core.checks import Float64Array, checked_intrinsics
from garps_core.cli.image_files import read_image, read_view
from garps_core.cli.report import as_json, as_text
from garps_core.cli.weights import app as weights_app
from garps_core.config import PRESETS, Config, Reconstruction, methods, start_methods
from garps_core.config.combinations import check_settings
from garps_core.config.start import TWO_VIEW
from garps_core.config.text import configured
from garps_core.devices import checked_device
from garps_core.errors import GarpsError, InitialisationError, InputError, ModelError, WeightsError
from garps_core.mixtures.splat_reader import read_splats
from garps_core.models.depth_networks import preset_for
from garps_core.point_maps import PairMaps
from garps_core.start.identity_start import identity
from garps_core.start.intrinsics import intrinsics_of
from garps_core.types import Mixture, PoseEstimate, Prior, Status, View
from garps_core.version import __version__

# typer 0.29 carries its own copy of click, older ones use the real one: BadParameter, UsageError, ClickException.
ClickException: type[Exception] = typer.BadParameter.__mro__[2]

Four = tuple[float, float, float, float]
Settings = Annotated[
    Path | None, typer.Option(help="YAML file of settings; --preset and --set stand above it.", metavar="FILE")
]
Changes = Annotated[
    list[str] | None,
    typer.Option("--set", help="Change a setting; may be repeated.", metavar="NAME=VALUE"),
]
app = typer.Typer(
    help="Metric relative pose of two cameras by aligning two 3D Gaussian mixtures.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
)
app.add_typer(weights_app, name="weights")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code. A user's mistake is one line on stderr and code 2."""
    try:
        code = app(args=arguments, prog_name="garps", standalone_mode=False)
        return code if isinstance(code, int) else 0
    except GarpsError as error:
        message = str(error)
    except ClickException as error:
        message = error.format_message()  # type: ignore[attr-defined]
        if not message:  # no arguments: the help has been printed
            return 2
    except typer.Abort:
        return 130
    print(f"garps: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"garps {__version__}")
        raise typer.Exit()


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None: ...


@app.command()
def align(
    source: Annotated[Path, typer.Argument(help="Image of the source camera, or splats (.ply).", metavar="SRC")],
    target: Annotated[Path, typer.Argument(help="Image of the target camera, or splats (.ply).", metavar="TGT")],
    K: Annotated[Four | None, typer.Option("--K", help="Intrinsics of images, px.", metavar="FX FY CX CY")] = None,
    K_target: Annotated[
        Four | None, typer.Option("--K-target", help="Intrinsics of TGT, px.", metavar="FX FY CX CY")
    ] = None,
    depth_source: Annotated[
        Path | None, typer.Option(help="Depth registered to SRC: 16-bit PNG (mm), .npy or float TIFF (m).")
    ] = None,
    depth_target: Annotated[Path | None, typer.Option(help="Depth registered to TGT.")] = None,
    depth_scale: Annotated[
        float | None, typer.Option(help="Metres per unit of the depth files. [integers 0.001, floats 1]")
    ] = None,
    prior: Annotated[
        str | None, typer.Option(help="Pose T_target_source, m and quaternion.", metavar='"X Y Z QX QY QZ QW"')
    ] = None,
    prior_sigma: Annotated[
        str | None, typer.Option(help='Its sigmas, m and rad. ["0.1 0.05"]', metavar='"METRES RADIANS"')
    ] = None,
    preset: Annotated[
        str | None, typer.Option(help=f"{', '.join(PRESETS)}. [default; without depth monocular]")
    ] = None,
    reconstruction: Annotated[str | None, typer.Option(help=f"{', '.join(methods())}. [auto]")] = None,
    start: Annotated[str | None, typer.Option(help=f"Start pose: {', '.join(start_methods())}. [auto]")] = None,
    set_: Changes = None,
    settings: Settings = None,
    device: Annotated[str | None, typer.Option(help="cpu, cuda, cuda:0 ... [cpu]")] = None,
    json_: Annotated[bool, typer.Option("--json", help="Print everything as JSON, full precision.")] = False,
    figure: Annotated[Path | None, typer.Option(help="Write a before/after picture (needs matplotlib).")] = None,
    ply: Annotated[Path | None, typer.Option(help="Write the mixtures as splat PLY files to this folder.")] = None,
) -> int:
    """Pose of the source camera in the target camera's frame, metric, with covariance.

    Points of the source go to the target as x_target = R x_source + t, m; optical frames: x right, y down, z forward.

    \b
    Example:
      garps align a.png b.png --K 525 525 319.5 239.5 \\
          --depth-source a_depth.png --depth-target b_depth.png --figure pair.png
      garps align a.png b.png --K 525 525 319.5 239.5        # by a network, see `garps weights`
      garps align a.png b.png --preset mast3r                # nothing else is known
      garps align a.png b.png --K 525 525 319.5 239.5 --preset demo_net    # no weights: a demonstration
      garps align a.ply b.ply --prior "0.2 0 0 0 0 0 1"      # splats of any producer, metres
    \b
    Exit code: 0 = converged, 1 = no pose to be trusted (the reason is printed), 2 = wrong input.
    """
    files, depths, Ks = (source, target), (depth_source, depth_target), (K, K_target)
    splats, given = _are_splats(files, reconstruction), _prior(prior, prior_sigma)
    changes = _changes(set_, {"device": device, "reconstruction.method": reconstruction, "start.method": start})
    with_depth = splats or any(depths)
    config = configured(preset, settings, changes, lambda asked: preset_for(asked.reconstruction.method, with_depth))
    checked_device(config.device)
    if splats:
        estimate, mixtures = _of_splats(files, config, given, any(depths + Ks))
    else:
        estimate, mixtures = _of_images(files, depths, Ks, depth_scale, config, given)
    print(json.dumps(as_json(estimate), indent=1, allow_nan=False) if json_ else as_text(estimate))
    _write_extras(estimate, mixtures, figure, ply)
    return 0 if estimate.ok else 1


@app.command()
def doctor() -> int:
    """Versions, devices, memory and a self-test of this installation, for a bug report.

    \b
    Exit code: 0 = all that is needed is here and works, 1 = not.
    """
    from garps_core.cli.doctor import examine

    rows, healthy = examine()
    for name, result in rows:
        print(f"{name:<15} {result}")
    return 0 if healthy else 1


def _are_splats(files: tuple[Path, Path], method: str | None) -> bool:
    splats = [file.suffix.lower() == ".ply" for file in files]
    if any(splats) != all(splats) or (method is not None and (method == "ply") != all(splats)):
        raise InputError(
            f"{files[0]} and {files[1]}{f' with --reconstruction {method}' if method else ''}: expected two images, or "
            "two splat files that end in .ply"
        )
    return all(splats)


def _of_splats(
    files: tuple[Path, Path], config: Config, start: Prior | None, of_images: bool
) -> tuple[PoseEstimate, tuple[Mixture, Mixture] | None]:
    asked = replace(config.reconstruction, method="ply") != Reconstruction(method="ply")
    if of_images or asked or config.reconstruction.method not in ("auto", "ply"):
        raise InputError(
            "splat files come with --K, depth files or settings of reconstruction: expected none, nothing is to be "
            "reconstructed. Leave them out"
        )

    x, y = (read_splats(file) for file in files)
    return align_mixtures(x, y, start or identity(config, "no --prior"), config), (x, y)


def _of_images(
    files: tuple[Path, Path],
    depths: tuple[Path | None, Path | None],
    Ks: tuple[Four | None, Four | None],
    scale: Any,
    config: Config,
    given: Prior | None,
) -> tuple[PoseEstimate, tuple[Mixture, Mixture] | None]:
    estimator = Estimator(config)
    try:
        source, target, maps = _views(files, depths, Ks, scale, estimator)
    except WeightsError:
        raise
    except (InitialisationError, ModelError) as failure:  # only a network that estimates intrinsics raises them
        return PoseEstimate(Status.NO_INITIAL_POSE, f"no --K, and none by {config.start.method}: {failure}"), None
    return estimator.estimate_with_mixtures(source, target, given, maps)


def _views(
    files: tuple[Path, Path],
    depths: tuple[Path | None, Path | None],
    Ks: tuple[Four | None, Four | None],
    scale: Any,
    estimator: Estimator,
) -> tuple[View, View, PairMaps | None]:
    if Ks[0] is None and Ks[1] is not None:
        raise InputError("--K-target is given without --K: expected both, --K alone if they are equal, or none")
    if Ks[0] is None:
        return _uncalibrated(files, depths, scale, estimator)
    of_source, of_target = _intrinsics("--K", Ks[0]), _intrinsics("--K-target", Ks[1] or Ks[0])
    return read_view(files[0], of_source, depths[0], scale), read_view(files[1], of_target, depths[1], scale), None


def _uncalibrated(
    files: tuple[Path, Path], depths: tuple[Path | None, Path | None], scale: Any, estimator: Estimator
) -> tuple[View, View, PairMaps]:
    config = estimator.config
    if config.start.method not in TWO_VIEW:
        raise InputError(
            "--K is missing: expected FX FY CX CY in pixels, from the camera's calibration; or a two-view network that "
            f"can estimate it, --start {' or '.join(TWO_VIEW)}"
        )
    if config.reconstruction.method == "two_view":
        check_settings(config)
    images = [read_image(file) for file in files]
    maps = estimator.networks.pair_maps(images[0], images[1], config)
    Ks = intrinsics_of(maps, (images[0].shape[:2], images[1].shape[:2]), config.start.min_confidence)
    source, target = (read_view(*given, scale, K_estimated=True) for given in zip(files, Ks, depths, strict=True))
    return source, target, maps


def _changes(given: list[str] | None, options: dict[str, str | None]) -> list[str]:
    """Return NAME=VALUE of --set, then of options that stand for a setting."""
    return [*(given or []), *(f"{name}={value}" for name, value in options.items() if value is not None)]


def _intrinsics(option: str, values: Four) -> Float64Array:
    fx, fy, cx, cy = values
    try:
        return checked_intrinsics(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    except InputError as error:
        raise InputError(f"{option}: {error}") from None


def _numbers(option: str, text: str, count: int, meaning: str) -> Float64Array:
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        raise InputError(f"{option} is {text!r}: expected {count} numbers, {meaning}") from None
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{option} is {text!r}: expected {count} finite numbers, {meaning}")
    return values


def _prior(pose: str | None, sigma: str | None) -> Prior | None:
    if pose is None:
        if sigma is not None:
            raise InputError("--prior-sigma is given without --prior: expected both or none")
        return None
    values = _numbers("--prior", pose, 7, '"x y z qx qy qz qw" in metres and a unit quaternion')
    norm = float(np.linalg.norm(values[3:]))
    if abs(norm - 1) > 0.01:
        raise InputError(f"--prior has a quaternion of length {norm:g}: expected 1, order qx qy qz qw")
    sigmas = _numbers("--prior-sigma", sigma or "0.1 0.05", 2, '"metres radians"')
    if (sigmas <= 0).any():
        raise InputError(f"--prior-sigma is {sigma!r}: expected two positive numbers, metres and radians")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
    return Prior(T, np.diag(np.repeat(sigmas**2, 3)))


def _write_extras(
    estimate: PoseEstimate, mixtures: tuple[Mixture, Mixture] | None, figure: Path | None, ply: Path | None
) -> None:
    if figure is None and ply is None:
        return
    if estimate.T_target_source is None or mixtures is None:
        print("garps: note: no pose, so no picture and no PLY files are written", file=sys.stderr)
        return
    if ply is not None:
        from garps_core.mixtures.splat_writer import write_aligned

        write_aligned(*mixtures, estimate.T_target_source, ply)
    if figure is not None:
        from garps_core.cli.figure import before_after

        start = np.eye(4) if estimate.initial is None else estimate.initial.T_target_source
        before_after(*mixtures, start, estimate.T_target_source, figure)
