# SPDX-License-Identifier: Apache-2.0
"""`python -m garps_core.cli` is `garps`."""

import sys

from garps_core.cli import main

sys.exit(main())
