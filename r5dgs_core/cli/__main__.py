"""Run the command line as ``python -m r5dgs_core.cli``."""

import sys

from .main import main

sys.exit(main())
