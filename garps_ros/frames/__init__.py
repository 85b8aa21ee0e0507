# SPDX-License-Identifier: Apache-2.0
"""Messages -> frames: `stamps` pairs two streams, `assembly` joins a frame, `frame` makes it a View."""
