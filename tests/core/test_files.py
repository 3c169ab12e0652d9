"""Files are replaced whole or not at all."""

import os

import pytest

from r5dgs_core.scene import files


def test_the_new_content_takes_the_place_of_the_old(tmp_path):
    path = tmp_path / "a.bin"
    for content in (b"first", b"", b"a longer second"):
        files.write(path, content)
        assert path.read_bytes() == content and os.listdir(tmp_path) == ["a.bin"]


@pytest.mark.parametrize("moment", ["block", "fsync", "replace"])
def test_after_an_error_the_old_content_is_there_and_nothing_else(tmp_path, monkeypatch, moment):
    path = tmp_path / "a.bin"
    files.write(path, b"old")

    def crash(*arguments):
        raise OSError(28, "No space left on device")

    if moment != "block":
        monkeypatch.setattr(files.os, moment, crash)
    with pytest.raises(OSError, match="No space left"), files.replacing(path) as stream:
        stream.write(b"half of the ne")
        if moment == "block":
            crash()
    monkeypatch.undo()
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["a.bin"]


def test_until_the_block_ends_the_old_content_is_there(tmp_path):
    path = tmp_path / "a.bin"
    files.write(path, b"old")
    with files.replacing(path) as stream:
        stream.write(b"new")
        stream.flush()
        assert path.read_bytes() == b"old"
        assert [p.read_bytes() for p in files.leftovers(path)] == [b"new"]
    assert path.read_bytes() == b"new" and files.leftovers(path) == []


def test_only_a_files_own_leftovers_are_found(tmp_path):
    for name in (".a.bin.12ab.part", ".b.bin.12ab.part", "a.bin.part", ".a.bin.part"):
        (tmp_path / name).touch()
    assert [p.name for p in files.leftovers(tmp_path / "a.bin")] == [".a.bin.12ab.part"]


def test_a_missing_folder_is_the_callers_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        files.write(tmp_path / "deep" / "a.bin", b"")
