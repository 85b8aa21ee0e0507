# SPDX-License-Identifier: Apache-2.0
"""Facts of the machine, the cost of a call, jobs on several processes."""
