# SPDX-License-Identifier: Apache-2.0
"""Messages -> frames: images, depth and calibration of one instant."""
