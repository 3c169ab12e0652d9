"""R5DGS core: semantic 4D Gaussians, their motion and their rendering. Does not depend on Blender.

The functions of `api` are loaded on first use, so that importing the package stays fast.
"""

import importlib

__version__ = "0.1.0"
__all__ = ["evaluate", "load", "picture", "poses", "save", "train_scene"]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(".api", __name__), name)
