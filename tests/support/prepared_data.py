"""Data sets that `r5dgs prepare` writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from r5dgs_core.cli.commands import prepare
from r5dgs_core.data import dataset


def prepared(source: Path, out: Path, **fields: Any) -> dataset.Dataset:
    """Prepare a data set without comparing clocks, and read it. Arguments as for `run_prepare`."""
    prepare.run_prepare(source, out, sync="none", **fields)
    return dataset.read(out)


def content(folder: Path) -> dict[Path, bytes]:
    """Return the bytes of all files below a folder by relative path."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
