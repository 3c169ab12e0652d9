"""The user's settings file, and `r5dgs config`."""

import json
import os
import sys
from pathlib import Path

import pytest

from r5dgs_core import user_settings
from r5dgs_core.cli import main, options
from r5dgs_core.cli.exit_status import ExitStatus
from r5dgs_core.config import config, config_keys
from r5dgs_core.errors import ConfigError
from r5dgs_core.train import run_folder
from tests.support import tiny_datasets
from tests.support.command_line import complaint


@pytest.fixture
def place():
    """The settings file, which is not there yet; `tests/core/conftest.py` gives each test an own folder."""
    found = user_settings.path()
    assert not found.exists()
    return found


def test_without_a_file_no_setting_has_a_value(place, capsys):
    assert user_settings.read() == {}
    assert main.main(["config", "--user"]) == 0
    shown = capsys.readouterr().out
    assert str(place) in shown and "does not exist yet" in shown
    assert all(f"{key} = (not set)" in shown for key in user_settings.MEANINGS)


@pytest.mark.parametrize("name", ["plain", 'quo"ted \\ back', "süß 日本 😀", "line\nbreak", "delete\x7f"])
def test_settings_can_be_read_back(place, tmp_path, capsys, name):
    folder = tmp_path / name
    folder.mkdir()
    assert main.main(["config", "--user", "set", "encoder", str(folder)]) == 0
    assert main.main(["config", "--user", "set", "worker_python", sys.executable]) == 0
    assert user_settings.read() == {"encoder": str(folder), "worker_python": sys.executable}
    capsys.readouterr()
    assert main.main(["config", "--user", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown == {"path": str(place), "settings": user_settings.read()}
    assert main.main(["config", "--user", "set", "encoder", ""]) == 0
    assert list(user_settings.read()) == ["worker_python"] and [p.name for p in place.parent.iterdir()] == [place.name]


def test_a_path_that_is_not_utf8_is_refused_and_leaves_the_file(place, tmp_path):
    user_settings.write("encoder", str(tmp_path))
    (tmp_path / "\udcff").mkdir()
    with pytest.raises(ConfigError, match="UTF-8"):
        user_settings.write("sam2", str(tmp_path / "\udcff"))
    assert user_settings.read() == {"encoder": str(tmp_path)} and list(place.parent.iterdir()) == [place]


def test_relative_paths_are_stored_absolute(place, tmp_path, monkeypatch):
    (tmp_path / "clip").mkdir()
    monkeypatch.chdir(tmp_path)
    user_settings.write("encoder", "clip")
    assert user_settings.read()["encoder"] == str(tmp_path / "clip")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('encoder = "a"\nsam2 = clip\n', "not valid TOML: .*line 2"),
        (
            'encoder = "a"\n\nsam3 = "b"\n',
            "line 3: expected one of the keys encoder, sam2, metrics.lpips_weights, worker_python, found 'sam3'",
        ),
        ('encoder = "a"\nsam2 = 3\n', "line 2: expected text in quotes, found sam2 = 3"),
        ('[paths]\nsam2 = "b"\n', "line 1: expected one of the keys"),
        ('encoder = "a"\nencoder = "b"\n', "not valid TOML: .*line 2"),
        (b"\xff\xfe", "cannot be read"),
    ],
)
def test_a_damaged_file_is_one_error_that_names_file_and_line(place, text, words):
    place.parent.mkdir(parents=True)
    place.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError, match=words) as caught:
        user_settings.read()
    assert str(caught.value).startswith(str(place))
    with pytest.raises(ConfigError):
        user_settings.write("sam2", "")
    assert place.read_bytes() == (text if isinstance(text, bytes) else text.encode()), "a damaged file stays as it is"


def test_wrong_settings_are_refused(place, tmp_path, capsys):
    said = complaint(capsys, "config", "--user", "set", "sam3", tmp_path, status=ExitStatus.USAGE)
    assert "expected one of the keys" in said
    said = complaint(capsys, "config", "--user", "get", "sam2", status=ExitStatus.USAGE)
    assert "'set KEY VALUE'" in said
    assert "found nothing" in complaint(capsys, "config", "--user", "set", "sam2", tmp_path / "no")
    assert "expected a program, found a folder" in complaint(
        capsys, "config", "--user", "set", "worker_python", tmp_path
    )
    assert not place.exists()


@pytest.mark.parametrize(
    ("platform", "variable", "below"),
    [
        ("linux", "XDG_CONFIG_HOME", "r5dgs/settings.toml"),
        ("win32", "APPDATA", "r5dgs/settings.toml"),
        ("darwin", "HOME", "Library/Application Support/r5dgs/settings.toml"),
    ],
)
def test_the_file_lies_in_the_configuration_folder_of_the_platform(monkeypatch, tmp_path, platform, variable, below):
    monkeypatch.setattr(user_settings.sys, "platform", platform)
    monkeypatch.setenv(variable, str(tmp_path))
    assert user_settings.path() == tmp_path / below


def test_every_key_of_the_configuration_has_a_meaning_and_a_unit():
    found = config_keys.keys(config.Config())
    assert all(key.meaning and key.unit and key.value == key.default for key in found)
    listed = [key for keys in config_keys._KEYS_BY_UNIT.values() for key in keys.split()]
    numbers = [key.name for key in found if isinstance(key.default, int | float) and not isinstance(key.default, bool)]
    assert sorted(listed) == sorted(numbers), "each number has one unit, and nothing else has"


def test_config_prints_defaults_files_and_runs(tiny, tmp_path, capsys):
    def shown(*target):
        assert main.main(["config", *map(str, target), "--json"]) == 0
        return {row["name"]: row for row in json.loads(capsys.readouterr().out)}

    assert all(row["value"] == row["default"] for row in shown().values())
    (tmp_path / "c.toml").write_text("[losses]\nssim = 0.1\n")
    row = shown(tmp_path / "c.toml")["losses.ssim"]
    assert (row["value"], row["default"], row["unit"]) == (0.1, 0.2, "share")
    settled = tiny_datasets.settings("train.seed=5")
    from r5dgs_core.data import dataset as datasets

    run_folder.create_run(tmp_path / "run", datasets.read(tiny.root), settled)
    assert shown(tmp_path / "run")["train.seed"]["value"] == 5
    assert main.main(["config", str(tmp_path / "run")]) == 0
    text = capsys.readouterr().out
    assert "seed = 5  # integer; default 0" in text and "    # Seed of all random draws." in text
    assert max(map(len, text.splitlines())) <= 80


def test_config_refuses_unreadable_values(tmp_path, capsys):
    assert "no such configuration file" in complaint(capsys, "config", tmp_path / "c.toml")
    assert "not a run folder" in complaint(capsys, "config", tmp_path)
    (tmp_path / "run.json").write_text('{"config": 3}')
    assert "expected the configuration of a run" in complaint(capsys, "config", tmp_path)
    (tmp_path / "run.json").write_text('{"config": {"losses": {"sim": 1}}}')
    assert "did you mean 'ssim'" in complaint(capsys, "config", tmp_path)


def test_weights_come_from_the_settings_unless_an_option_names_others(place, tiny, tmp_path, capsys):
    weights = tmp_path / "weights"
    weights.mkdir()
    scene = tmp_path / "no.r5dgs"
    said = complaint(capsys, "lookup", scene, status=ExitStatus.USAGE)
    assert "config --user set encoder DIR" in said
    said = complaint(capsys, "masks", tiny.root, "--backend", "sam2", status=ExitStatus.USAGE)
    assert "config --user set sam2 DIR" in said
    for key in ("encoder", "sam2"):
        user_settings.write(key, str(weights))
    assert "expected a .r5dgs file" in complaint(capsys, "lookup", scene)
    assert str(weights) in complaint(capsys, "masks", tiny.root, "--backend", "sam2")
    other = complaint(capsys, "masks", tiny.root, "--backend", "sam2", "--model", tmp_path / "other")
    assert str(tmp_path / "other") in other


def test_the_weights_of_lpips_are_one_or_several_files(place, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("features.pth", "heads.pth"):
        (tmp_path / name).touch()
    given = os.pathsep.join(("features.pth", "heads.pth"))
    assert main.main(["config", "--user", "set", user_settings.LPIPS, given]) == 0
    stored = os.pathsep.join(str(tmp_path / name) for name in ("features.pth", "heads.pth"))
    assert user_settings.read() == {user_settings.LPIPS: stored}
    files = (tmp_path / "features.pth", tmp_path / "heads.pth")
    assert options.lpips_files(None) == files and options.lpips_files(files[:1]) == files[:1]
    place.write_text(f'[metrics]\nlpips_weights = "{files[0]}"\n')
    assert options.lpips_files(None) == files[:1]
    files[0].unlink()
    with pytest.raises(ConfigError, match=r"metrics\.lpips_weights .*features\.pth: expected a file"):
        options.lpips_files(None)
    line = complaint(capsys, "config", "--user", "set", user_settings.LPIPS, "heads.pth" + os.pathsep + "no.pth")
    assert "no.pth: expected a file, found none" in line
    with pytest.raises(ConfigError, match="--lpips no.pth"):
        options.lpips_files([Path("no.pth")])
