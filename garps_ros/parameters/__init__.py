# SPDX-License-Identifier: Apache-2.0
"""Settings as parameters of the node, and their page."""
