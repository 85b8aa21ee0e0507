# SPDX-License-Identifier: Apache-2.0
"""Cost of the live node: `python -m bench.live`."""
