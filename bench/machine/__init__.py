# SPDX-License-Identifier: Apache-2.0
"""What depends on the machine: its facts, the cost of a call, jobs on several processes."""
