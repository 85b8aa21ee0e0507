# SPDX-License-Identifier: Apache-2.0
"""Files of weights: the list, the folder, fetching, and safe reading."""
