# SPDX-License-Identifier: Apache-2.0
"""Frames -> estimates: `outcomes` of pairs and single frames, `keyframes` of one camera, `preparation` before both."""
