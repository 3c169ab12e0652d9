"""The data set that an output folder already has: continued if it is the same, else replaced or refused.

Without ``--overwrite``, only an unfinished data set is replaced, and only files that `r5dgs prepare` wrote are removed.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from .. import errors, folder_lock
from ..data.annotations import OBJECTS
from ..data.layouts.camera_files import POINTS
from ..data.view_masks import MASKS
from . import capture_file, unknown_cameras
from .plan import IMAGES

_OWN_FILES = ("transforms_train.json", "transforms_val.json", "transforms_test.json", POINTS, capture_file.FILE)
_LATER = (MASKS, "check", OBJECTS)  # made when the data set is finished
OTHER_INPUT = "was prepared from other input or settings"


def present(out: Path) -> dict[str, Any] | None:
    """Return the record of the data set in a folder, or None.

    Raises:
        DatasetError: There are files but no record, or the record is damaged.
    """
    found = capture_file.read(out)
    if found is None:
        own = {folder_lock.LOCK_FILE, unknown_cameras.FILE, unknown_cameras.WORK}
        foreign = [path.name for path in out.iterdir() if path.name not in own]
        if foreign:
            raise errors.DatasetError(
                f"{out}: expected an empty folder or a prepared data set, found {foreign[0]}; name another folder"
            )
    return found


def check_outside(out: Path, given: Path) -> None:
    """Check that an input is outside the places of the data set that are replaced.

    Raises:
        ConfigError: It is in one of them.
    """
    path = Path(given).resolve()
    for name in (IMAGES, *_LATER):
        if path.is_relative_to((out / name).resolve()):
            raise errors.ConfigError(
                f"{given}: is in {out / name}, which is replaced; copy it elsewhere, or name another folder with --out"
            )


def check_replaceable(out: Path, record: dict[str, Any], changed: Iterable[str]) -> None:
    """Check that a data set may be replaced without ``--overwrite``.

    Args:
        out: Its folder.
        record: Its record.
        changed: Names of the settings and input that changed.

    Raises:
        DatasetError: It is finished, or has files that prepare did not write.
    """
    if record.get("finished") is not False:
        raise errors.DatasetError(
            f"{out}: {OTHER_INPUT} ({', '.join(changed)}); name another folder with --out, or give --overwrite"
        )
    if foreign := _foreign(out, record):
        raise errors.DatasetError(
            f"{out}: {OTHER_INPUT} ({', '.join(changed)}), and {foreign} is not a file of prepare; move it elsewhere, "
            "name another folder with --out, or give --overwrite to remove it"
        )


def _foreign(out: Path, record: dict[str, Any]) -> str | None:
    """Return the name of a file in the replaced places that prepare did not write, or None."""
    for name in _LATER:
        if (out / name).exists():
            return name
    listed = record.get("image_files")
    own = {str(out / str(name)) for name in listed} if isinstance(listed, list) else set()
    for path in sorted((out / IMAGES).rglob("*")):
        temporary = path.name.startswith(".") and str(path.with_name(path.name[1:].rsplit(".", 2)[0])) in own
        if not path.is_dir() and str(path) not in own and not temporary:
            return str(path.relative_to(out))
    return None


def remove(out: Path) -> None:
    """Remove the files of a data set, but not its reconstructed cameras."""
    for name in (IMAGES, *_LATER, *_OWN_FILES):
        path = out / name
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
