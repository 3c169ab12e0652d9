"""Configurations: files and overrides become typed values, and unusable values are named."""

import dataclasses
import json
import re

import hypothesis
import pytest
from hypothesis import strategies as st

from r5dgs_core.config import config, rules
from r5dgs_core.errors import ConfigError


@hypothesis.given(
    st.fixed_dictionaries(
        {
            "train": st.fixed_dictionaries({"iterations": st.integers(1, 10**6), "sh_degree": st.integers(0, 3)}),
            "losses": st.fixed_dictionaries({"ssim": st.floats(0, 1)}),
            "rates": st.fixed_dictionaries({}, optional={"means": st.floats(0, 1), "decay": st.integers(1, 1)}),
        }
    )
)
def test_configurations_survive_a_round_trip_through_json(values):
    made = config.from_dict(values)
    assert config.from_dict(json.loads(json.dumps(made.to_dict()))) == made
    assert made.train.iterations == values["train"]["iterations"]


def test_omitted_keys_keep_their_defaults():
    made = config.from_dict({"train": {"seed": 3}})
    assert made.train.seed == 3
    assert made.replace(**{"train.seed": 0}) == config.Config()


def test_overrides_win_over_the_file(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text("[train]\niterations = 10\nseed = 4\n[losses]\nssim = 0.5\n")
    made = config.load(path, ["train.iterations=20", "train.background=white", "train.shading = false"])
    assert (made.train.iterations, made.train.seed, made.losses.ssim) == (20, 4, 0.5)
    assert made.train.background == "white" and made.train.shading is False


def test_the_last_of_two_overrides_wins_and_whole_numbers_serve_as_decimals():
    made = config.load(None, ["losses.ssim=0.3", "losses.ssim=1"])
    assert made.losses.ssim == 1.0 and isinstance(made.losses.ssim, float)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("losses.sim=0.1", "losses.sim: unknown key; did you mean 'ssim'?"),
        ("loses.ssim=0.1", r"\[loses\]: unknown section; did you mean 'losses'?"),
        ("losses.zzzz=1", "losses.zzzz: unknown key; known are rigid, rigid_form, rigid_start, roughness, ssim"),
        ("train.iterations=1.5", "train.iterations: expected int, got 1.5"),
        ("train.iterations=true", "train.iterations: expected int, got True"),
        ("train.shading=1", "train.shading: expected bool, got 1"),
        ("train.shading=maybe", "train.shading: expected bool, got 'maybe'"),
        ("losses.ssim=high", "losses.ssim: expected float, got 'high'"),
        ("losses.ssim=1.5", "losses.ssim: expected 0 to 1, got 1.5"),
        ("train.iterations=0", "train.iterations: expected at least 1, got 0"),
        ("train.sh_degree=4", "train.sh_degree: expected 0 to 3, got 4"),
        ("train.background=gray", "train.background: expected auto or learned or white or black, got 'gray'"),
        ("init.opacity=1", "init.opacity: expected between 0 and 1, got 1.0"),
        ("init.object_points=0", "init.object_points: expected at least 1, got 0"),
        ("init.background_points=0", "init.background_points: expected at least 1, got 0"),
        ("init.sweep_depths=1", "init.sweep_depths: expected at least 2, got 1"),
        ("init.min_mask_pixels=1", "init.min_mask_pixels: expected less than 1, got 1.0"),
        ("rates.decay=0", "rates.decay: expected more than 0, at most 1, got 0.0"),
        ("rates.decay_from=1.1", "rates.decay_from: expected 0 to 1, got 1.1"),
        ("rates.decay_floor_appearance=2", "rates.decay_floor_appearance: expected 0 to 1, got 2.0"),
        ("curriculum.newest=1.5", "curriculum.newest: expected 0 to 1, got 1.5"),
        ("densify.stop=2", "densify.stop: expected 0 to 1, got 2.0"),
        ("densify.share=1.01", "densify.share: expected 0 to 1, got 1.01"),
        ("densify.every=0", "densify.every: expected at least 1, got 0"),
        ("densify.prune_opacity=1", "densify.prune_opacity: expected less than 1, got 1.0"),
        ("densify.prune_width=0", "densify.prune_width: expected more than 0, got 0.0"),
        ("train.seed=9223372036854775807", "train.seed: expected less than"),
        ("losses.ssim", "expected SECTION.KEY=VALUE"),
        ("ssim=0.1", "expected SECTION.KEY=VALUE"),
        ("a.b.c=1", "expected SECTION.KEY=VALUE"),
    ],
)
def test_invalid_overrides_raise_with_their_key(override, message):
    with pytest.raises(ConfigError, match=message.replace("?", r"\?")):
        config.load(None, [override])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("train = 3", "train: expected a section with keys, got 3"),
        ("[train\n", "not valid TOML"),
        ("[train]\nseed = 2026-01-01", "train.seed: expected int, got datetime.date"),
        ("[train]\niteration = 3", "train.iteration: unknown key; did you mean 'iterations'?"),
    ],
)
def test_faults_of_a_file_are_named(tmp_path, text, message):
    path = tmp_path / "c.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=f"c.toml: {message}".replace("?", r"\?")):
        config.load(path)


def test_an_override_of_an_unknown_section_is_refused(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text("train = 3")
    with pytest.raises(ConfigError, match="train"):
        config.load(path, ["train.seed=1"])


@pytest.mark.parametrize("value", ["nan", "inf", "-1"])
def test_numbers_outside_the_range_of_a_key_are_refused(value):
    with pytest.raises(ConfigError, match="rates.means"):
        config.load(None, [f"rates.means={value}"])


@pytest.mark.parametrize("section", [f.name for f in dataclasses.fields(config.Config)])
def test_every_key_is_documented(section):
    kind = type(getattr(config.Config(), section))
    described = re.findall(r"^        (\w+): \S", kind.__doc__, re.MULTILINE)
    assert described == [f.name for f in dataclasses.fields(kind)]


def test_every_rule_belongs_to_a_key_and_accepts_its_default():
    for name, (good, _) in rules.RULES.items():
        section, key = name.split(".")
        assert good(getattr(getattr(config.Config(), section), key)), name


def test_a_missing_configuration_file_raises(tmp_path):
    with pytest.raises(ConfigError, match="c.toml: no such configuration file"):
        config.load(tmp_path / "c.toml")


def test_a_preset_wins_over_defaults_and_loses_to_file_and_overrides(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text("[identity]\niterations = 7\n")
    fast = config.load(None, preset="fast")
    assert 0 < fast.train.iterations < config.Config().train.iterations
    mixed = config.load(path, ["train.seed=3"], "fast")
    assert (mixed.train.iterations, mixed.identity.iterations) == (fast.train.iterations, 7)
    assert config.load(path, ["train.iterations=9"], "fast").train.iterations == 9


@pytest.mark.parametrize("name", config.PRESETS)
def test_every_preset_can_be_used(name):
    made = config.load(None, preset=name)
    for key, value in config.PRESETS[name].items():
        section, _, field = key.partition(".")
        assert getattr(getattr(made, section), field) == value


def test_an_unknown_preset_is_refused_with_the_nearest_name():
    with pytest.raises(ConfigError, match=r"--preset fats: unknown preset; did you mean 'fast'\?"):
        config.load(None, preset="fats")


def test_a_file_with_faults_is_named_also_with_a_preset(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text("train = 3")
    with pytest.raises(ConfigError, match="train: expected a section with keys, got 3"):
        config.load(path, preset="fast")


def test_overrides_change_an_existing_configuration():
    made = config.load(None, ["train.seed=3"]).override(["losses.ssim=0.5", "needs.shadows=off"])
    assert (made.train.seed, made.losses.ssim, made.needs.shadows) == (3, 0.5, "off")


@pytest.mark.parametrize(
    "text",
    [
        "[train]\niterations = " + "9" * 5000,
        "a = " + "[" * 5000,
        "[losses]\nssim = 1" + "0" * 400,
        "#" * (1 << 20) + "\n",
    ],
)
def test_a_file_that_cannot_be_a_configuration_is_one_error(tmp_path, text):
    path = tmp_path / "c.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"c\.toml|losses\.ssim"):
        config.load(path)


@pytest.mark.parametrize(
    "text", ["train.iterations=" + "9" * 5000, "losses.ssim=1" + "0" * 400, "train.background=" + "[" * 5000]
)
def test_an_override_that_fits_no_key_is_one_error(text):
    with pytest.raises(ConfigError, match="--set"):
        config.load(None, [text])
