# SPDX-License-Identifier: Apache-2.0
"""Where the two views agree best."""
