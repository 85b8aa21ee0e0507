# SPDX-License-Identifier: Apache-2.0
"""Networks, written from their published descriptions; weights come from the user, under the names of their files."""
