"""``python -m r5dgs_core``: the command ``r5dgs``, for programs that start Python modules, such as ``torchrun``."""

import os
import sys

os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")  # torch warns of each process that ends before this one

from .cli import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main.main())
