# SPDX-License-Identifier: Apache-2.0
"""Solvers, which find the pose at which the two views agree best."""
