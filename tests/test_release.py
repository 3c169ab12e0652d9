"""The script that bundles wheels with the extension, and its pins."""

import hashlib
import re
import tomllib
from pathlib import Path

import pytest

from release import build_extension

ROOT = Path(__file__).resolve().parents[1]


def target(until="5.1.0"):
    wheel = {"name": "numba", "version": "1.0", "python": "3.11", "file": "numba-1.0-cp311-cp311-win_amd64.whl"}
    return build_extension.Target("windows-x64", "3.11", "4.2.0", until, (wheel,))


def test_the_pinned_wheels_are_the_tested_versions_for_every_platform_and_python():
    pins = tomllib.loads(build_extension.PINS.read_text())
    tested = dict(re.findall(r"^(numba|llvmlite)==(\S+)$", (ROOT / "constraints.txt").read_text(), re.M))
    found = build_extension.targets((), ())
    assert {(t.platform, t.python) for t in found} == {
        (platform, python) for platform in ("linux-x64", "windows-x64", "macos-arm64") for python in pins["blender"]
    }
    for one in found:
        assert {wheel["name"]: wheel["version"] for wheel in one.wheels} == tested
        assert all(f"-cp{one.python.replace('.', '')}-" in wheel["file"] for wheel in one.wheels)


def test_the_first_blender_is_that_of_the_manifest_and_ranges_do_not_overlap():
    versions = tomllib.loads(build_extension.PINS.read_text())["blender"].values()
    plain = tomllib.loads((ROOT / "blender_manifest.toml").read_text())
    ordered = sorted(versions, key=lambda v: [int(n) for n in v["from"].split(".")])
    assert ordered[0]["from"] == plain["blender_version_min"]
    assert [v.get("until") for v in ordered] == [*(v["from"] for v in ordered[1:]), None]


@pytest.mark.parametrize("until", ["5.1.0", ""])
def test_the_manifest_of_a_zip_names_versions_platform_and_wheels_and_keeps_the_rest(until):
    text = (ROOT / "blender_manifest.toml").read_text()
    plain, made = tomllib.loads(text), tomllib.loads(build_extension.manifest(text, target(until)))
    assert made.pop("blender_version_max", "") == until
    assert made.pop("platforms") == ["windows-x64"]
    assert made.pop("wheels") == ["./wheels/numba-1.0-cp311-cp311-win_amd64.whl"]
    assert made == plain


def test_another_file_than_the_pinned_one_is_refused(tmp_path):
    path = tmp_path / "numba-1.0-cp311-cp311-win_amd64.whl"
    path.write_bytes(b"pinned")
    pin = {**target().wheels[0], "sha256": hashlib.sha256(b"pinned").hexdigest()}
    assert build_extension.download(pin, tmp_path) == path
    path.write_bytes(b"changed")
    with pytest.raises(SystemExit, match="expected SHA-256 .*; delete it and check the pin"):
        build_extension.download(pin, tmp_path)


def test_a_platform_without_wheels_is_named():
    with pytest.raises(SystemExit, match="no wheels for solaris"):
        build_extension.targets(["solaris"], [])
