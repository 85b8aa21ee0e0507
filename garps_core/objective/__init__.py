# SPDX-License-Identifier: Apache-2.0
"""How well two views agree under a pose."""
