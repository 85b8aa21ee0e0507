# SPDX-License-Identifier: Apache-2.0
"""Two views -> start poses with covariance."""
