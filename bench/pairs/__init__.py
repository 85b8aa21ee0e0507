# SPDX-License-Identifier: Apache-2.0
"""Pairs of views with a known pose."""
