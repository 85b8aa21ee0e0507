# SPDX-License-Identifier: Apache-2.0
"""Verdict on an alignment: covariance, status, quality."""
