# SPDX-License-Identifier: Apache-2.0
"""Views to mixtures: lifting, Flash3D, and splat files."""
