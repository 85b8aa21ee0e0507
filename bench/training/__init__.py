# SPDX-License-Identifier: Apache-2.0
"""Pictures with true depth that demo_net is trained on."""
