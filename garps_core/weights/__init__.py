# SPDX-License-Identifier: Apache-2.0
"""Files of weights: known, found, fetched, and read safely."""
