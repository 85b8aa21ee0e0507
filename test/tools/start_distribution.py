# SPDX-License-Identifier: Apache-2.0
"""A distribution with ways to start, installed for a test only: one that was told the pose, and those that fail."""

from pathlib import Path

import numpy as np
from distributions import write_distribution

from garps_core.config.start import START_PLUGINS

NAME = "told_start"
"""The way to start that returns the pose it was installed with."""
ASKED = "asked.txt"
"""File in the distribution's folder with a line for every call of `NAME`."""
MODULE = """
from pathlib import Path

import numpy as np

from garps_core import Prior
from garps_core.errors import InitialisationError, ModelError, WeightsError

FOLDER = Path(__file__).parent
COVARIANCE = np.diag([0.02**2] * 3 + [0.01**2] * 3)


class Start:
    def __init__(self, find):
        self.description, self.find = "the pose of a file", find


def told(source, target, config):
    with (FOLDER / "asked.txt").open("a") as file:
        file.write(f"{source.depth is not None} {config.start.method}\\n")
    return Prior(np.load(FOLDER / "truth.npy"), COVARIANCE, reason="told")


def no_pose(source, target, config):
    raise InitialisationError("no marker that both cameras see")


def no_memory(source, target, config):
    raise ModelError("too little memory")


def no_weights(source, target, config):
    raise WeightsError("no weights of the markers")


told = Start(told)
no_pose, no_memory, no_weights = Start(no_pose), Start(no_memory), Start(no_weights)
raising = Start(lambda source, target, config: {}[0])
matrix = Start(lambda source, target, config: np.eye(4))
singular = Start(lambda source, target, config: Prior(np.eye(4), np.zeros((6, 6))))
no_method = 7
no_description = type("Nameless", (), {"find": lambda *given: None})()
"""
FAILING = {
    "no_pose": "^no marker that both cameras see$",
    "no_memory": r"^the way to start .no_memory. \(made_start:no_memory of made_start 1\.0\) failed: too little memory",
    "raising": r"^the way to start .raising. \(made_start:raising of made_start 1\.0\) failed: KeyError: 0$",
    "matrix": r"^the way to start .matrix. \(made_start:matrix of made_start 1\.0\) returned ndarray: expected a Prior",
    "singular": r"^the way to start 'singular' .* failed: prior covariance ",
}
"""Ways to start that find no pose -> the reason in the estimate."""
MISTAKEN = {
    "not_there": r"of made_start 1\.0\) cannot be imported; update or remove it: ModuleNotFoundError: No module",
    "no_method": r"\(made_start:no_method of made_start 1\.0\) is an object of int: expected an object with",
    "no_description": r"is an object of Nameless: expected an object with `description` and `find`; docs/extending\.md",
    "a_class": r"\(made_start:Start of made_start 1\.0\) is the class Start: expected an object",
}
"""Ways to start that cannot be had -> the ConfigError."""


def install_starts(folder: Path, truth: np.ndarray) -> Path:
    """Write the distribution `made_start` 1.0, told the pose T_target_source; the folder belongs on the path."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "made_start.py").write_text(MODULE, encoding="utf-8")
    np.save(folder / "truth.npy", truth)
    names = [*FAILING, "no_weights", "no_method", "no_description"]
    entries = {NAME: "made_start:told", **{name: f"made_start:{name}" for name in names}}
    entries |= {"not_there": "no_such_package:START", "a_class": "made_start:Start"}
    taken = dict.fromkeys(("auto", "features", "given"), "made_start:raising")
    return write_distribution(folder, "made_start", START_PLUGINS, entries | taken)
