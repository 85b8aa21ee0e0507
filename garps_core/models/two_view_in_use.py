# SPDX-License-Identifier: Apache-2.0
"""Two-view networks, loaded by name; and adapters, which other distributions install."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points

from garps_core.errors import ConfigError, GarpsError, InputError, ModelError, WeightsError
from garps_core.models.mast3r import NaverModel
from garps_core.models.two_view import TwoView, built_from
from garps_core.point_maps import PairMaps, Picture, TwoViewModel
from garps_core.weights.load import load_weights
from garps_core.weights.manifest import of_file

__all__ = ["ADAPTERS", "NaverModel", "load_adapter", "load_network", "maps_by_adapter"]

ADAPTERS = "garps_core.two_view"
"""Entry points of installed packages in this group are adapters: `NAME = "package.module:load"`."""


def load_network(kind: str, weights: str) -> tuple[TwoView, str]:
    """MASt3R or DUSt3R with weights by name or file ("" = the first installed), and the variant of the weights.

    Raises WeightsError where they are not installed, or of another network.
    """
    path, read = load_weights(weights, kind)
    known = of_file(path.name)
    network = built_from(read.tensors)
    if (network.architecture.descriptors > 0) != (kind == "mast3r"):
        raise WeightsError(f"{path} holds {network.architecture.name}: expected weights of {kind}, start.method")
    return network, known.variant if known is not None else read.metadata.get("variant", "")


def load_adapter(name: str, weights: str, device: str) -> TwoViewModel:
    """The adapter of that name. Raises ConfigError where none is installed, or it cannot be loaded; WeightsError."""
    there = {point.name: point for point in entry_points(group=ADAPTERS)}
    if name not in there:
        raise ConfigError(
            f"start.adapter is {name!r}: expected the name of an installed adapter, one of "
            f"{', '.join(sorted(there)) or 'none there are'}. docs/two_view_models.md shows how to write one"
        )
    try:
        load: Callable[[str, str], TwoViewModel] = there[name].load()
        return load(weights, device)
    except GarpsError:
        raise
    except Exception as error:  # whatever is wrong with a package of somebody else's, or with its weights
        raise ConfigError(f"the adapter {name!r} ({there[name].value}) cannot be loaded: {_told(error)}") from error


def maps_by_adapter(name: str, model: TwoViewModel, source: Picture, target: Picture) -> PairMaps:
    """Point maps by an adapter. Raises ModelError for any exception in it, or a result that is not `PairMaps`."""
    try:
        found = model(source, target)
    except (ConfigError, InputError, WeightsError):
        raise
    except Exception as error:
        raise ModelError(f"the adapter {name!r} failed ({_told(error)})") from error
    if not isinstance(found, PairMaps):
        raise ModelError(f"the adapter {name!r} returned an object of class {type(found).__name__}: expected PairMaps")
    return found


def _told(error: Exception) -> str:
    return str(error) if isinstance(error, GarpsError) else f"{type(error).__name__}: {error}"
