# SPDX-License-Identifier: Apache-2.0
"""Recordings -> frames; estimates -> files."""
