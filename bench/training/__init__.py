# SPDX-License-Identifier: Apache-2.0
"""What demo_net is trained on."""
