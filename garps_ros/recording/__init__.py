# SPDX-License-Identifier: Apache-2.0
"""Recordings -> frames (`bags`, `topics`, `frame_reader`), results -> files (`session`, `outputs`), and `playback`."""
