# SPDX-License-Identifier: Apache-2.0
"""Speed tables: `python -m bench.speed`."""
