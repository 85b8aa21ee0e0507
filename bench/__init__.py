# SPDX-License-Identifier: Apache-2.0
"""Benchmarks, synthetic rooms and their comparisons."""
