# SPDX-License-Identifier: Apache-2.0
"""What to think of an alignment: covariance, status, quality."""
