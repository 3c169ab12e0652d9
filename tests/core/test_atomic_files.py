"""Files are replaced whole or not at all."""

import os

import pytest

from r5dgs_core import atomic_files


def test_the_new_content_replaces_the_old(tmp_path):
    path = tmp_path / "a.bin"
    for content in (b"first", b"", b"a longer second"):
        atomic_files.write(path, content)
        assert path.read_bytes() == content and os.listdir(tmp_path) == ["a.bin"]


@pytest.mark.parametrize("moment", ["block", "fsync", "replace"])
def test_after_an_error_only_the_old_content_remains(tmp_path, monkeypatch, moment):
    path = tmp_path / "a.bin"
    atomic_files.write(path, b"old")

    def crash(*arguments):
        raise OSError(28, "No space left on device")

    if moment != "block":
        monkeypatch.setattr(atomic_files.os, moment, crash)
    with pytest.raises(OSError, match="No space left"), atomic_files.replacing(path) as stream:
        stream.write(b"half of the ne")
        if moment == "block":
            crash()
    monkeypatch.undo()
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["a.bin"]


def test_the_old_content_is_kept_until_the_block_ends(tmp_path):
    path = tmp_path / "a.bin"
    atomic_files.write(path, b"old")
    with atomic_files.replacing(path) as stream:
        stream.write(b"new")
        stream.flush()
        assert path.read_bytes() == b"old"
        assert [p.read_bytes() for p in atomic_files.leftovers(path)] == [b"new"]
    assert path.read_bytes() == b"new" and atomic_files.leftovers(path) == []


def test_a_library_that_opens_files_itself_gets_an_empty_file_of_the_same_kind(tmp_path):
    path = tmp_path / "a.png"
    atomic_files.write(path, b"old")
    with atomic_files.replacing_by_name(path) as temporary:
        assert temporary.suffix == ".png" and temporary.read_bytes() == b"" and path.read_bytes() == b"old"
        temporary.write_bytes(b"new")
    assert path.read_bytes() == b"new" and os.listdir(tmp_path) == ["a.png"]
    with pytest.raises(KeyError), atomic_files.replacing_by_name(path) as temporary:
        raise KeyError
    assert path.read_bytes() == b"new" and os.listdir(tmp_path) == ["a.png"]


@pytest.mark.skipif(os.name != "posix", reason="links need rights on Windows")
@pytest.mark.parametrize("write", ["content", "name"])
def test_a_link_in_the_place_of_a_temporary_file_is_not_written_through(tmp_path, monkeypatch, write):
    monkeypatch.setattr(atomic_files.secrets, "token_hex", lambda _: "12ab")
    precious = tmp_path / "precious"
    precious.write_bytes(b"kept")
    for suffix in (".part", ".png"):
        (tmp_path / f".a.png.12ab{suffix}").symlink_to(precious)
    with pytest.raises(FileExistsError):
        if write == "content":
            atomic_files.write(tmp_path / "a.png", b"new")
        else:
            with atomic_files.replacing_by_name(tmp_path / "a.png"):
                pass
    assert precious.read_bytes() == b"kept" and not (tmp_path / "a.png").exists()


def test_new_files_have_the_permissions_that_the_user_chose(tmp_path):
    before = os.umask(0o027)
    try:
        atomic_files.write(tmp_path / "a.bin", b"")
        with atomic_files.replacing_by_name(tmp_path / "b.png"):
            pass
    finally:
        os.umask(before)
    modes = {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    assert modes == {0o640} or os.name != "posix"


def test_only_leftovers_of_the_same_file_are_found(tmp_path):
    for name in (".a.bin.12ab.part", ".b.bin.12ab.part", "a.bin.part", ".a.bin.part"):
        (tmp_path / name).touch()
    assert [p.name for p in atomic_files.leftovers(tmp_path / "a.bin")] == [".a.bin.12ab.part"]


def test_a_missing_folder_raises_in_the_caller(tmp_path):
    with pytest.raises(FileNotFoundError):
        atomic_files.write(tmp_path / "deep" / "a.bin", b"")
