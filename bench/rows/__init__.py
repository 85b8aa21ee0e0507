# SPDX-License-Identifier: Apache-2.0
"""Methods on pairs -> rows."""
