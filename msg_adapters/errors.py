# SPDX-License-Identifier: Apache-2.0
"""The one error this package raises on purpose."""


class MessageError(ValueError):
    """A message whose fields contradict each other or cannot be used; the text says what was given and expected."""
