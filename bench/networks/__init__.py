# SPDX-License-Identifier: Apache-2.0
"""Time and memory of the networks: `python -m bench.networks`."""
