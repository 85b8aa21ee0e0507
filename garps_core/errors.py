# SPDX-License-Identifier: Apache-2.0
"""Every error this package raises on purpose. Each text says what was given, what was expected, what to do."""


class GarpsError(Exception):
    """Base of all errors raised on purpose; catching it never hides a programming mistake."""


class InputError(GarpsError, ValueError):
    """An image, calibration, prior or mixture that cannot be what it claims to be."""


class ConfigError(GarpsError, ValueError):
    """A setting that does not exist, or a value outside its range."""


class ReconstructionError(GarpsError):
    """A view that is well formed but holds too little depth to become a mixture."""


class MissingDepthError(ReconstructionError):
    """A view comes without any depth image where a sensor's is wanted: a mistake of the caller, not of the scene."""


class InitialisationError(GarpsError):
    """No initial pose: too few feature matches fit one pose and no other start is allowed."""


class ModelError(GarpsError):
    """A network or its weights that cannot be used."""


class WeightsError(ModelError):
    """Weights that do not fit the network they were given to."""
