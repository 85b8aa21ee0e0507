# SPDX-License-Identifier: Apache-2.0
"""The objective: the agreement of two views under a pose, by shape and by brightness."""
