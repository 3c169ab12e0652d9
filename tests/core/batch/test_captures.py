"""Files of captures: settings, defaults, and one clear error."""

import pytest

from r5dgs_core.batch import captures
from r5dgs_core.errors import ConfigError

GOOD = """
[defaults]
preset = "fast"
set = ["train.seed=1"]
[cluster]
slurm_partition = "gpu"
[[capture]]
data = "kitchen"
[[capture]]
data = "kitchen"
name = "again"
device = "cpu"
set = ["train.seed=2"]
"""


@pytest.fixture
def written(tmp_path):
    def write(text):
        (tmp_path / "kitchen").mkdir(exist_ok=True)
        path = tmp_path / "captures.toml"
        path.write_text(text)
        return path

    return write


def test_captures_extend_the_defaults(written):
    batch = captures.read(written(GOOD))
    first, again = batch.captures
    assert (first.name, first.config.train.device, first.data.name) == ("kitchen", "auto", "kitchen")
    assert first.arguments == ("--preset", "fast", "--set", "train.seed=1")
    assert (again.name, again.config.train.device) == ("again", "cpu")
    assert again.arguments[-4:] == ("--set", "train.seed=1", "--set", "train.seed=2")
    assert batch.resources == {"slurm_partition": "gpu"}


def test_the_device_may_be_a_setting(written):
    (capture,) = captures.read(written("[[capture]]\ndata = 'kitchen'\nset = ['train.device=cpu']")).captures
    assert capture.config.train.device == "cpu"


CAPTURE = '[[capture]]\ndata = "kitchen"\n'


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "for each capture, found none"),
        ("[[capture]", "not valid TOML"),
        ("capture = [3]", "capture 1: expected a table"),
        ("capture = 3", "capture: expected a list, found 3"),
        ("[[capture]]\nname = 'x'", "capture 1: expected the key 'data'"),
        ("[[capture]]\ndata = 'garden'", "capture 1: data: .*garden is not a folder"),
        (CAPTURE + "data_ = 3", "capture 1: unknown key 'data_'; expected one of data, name"),
        (CAPTURE + "preset = 3", "capture 1: preset: expected text, found 3"),
        (CAPTURE + "set = [3]", "capture 1: set: expected texts"),
        (CAPTURE + "set = ['train.sed=3']", "capture 1: .*did you mean 'seed'"),
        (CAPTURE + "device = 'tpu'", "capture 1: .*device"),
        (CAPTURE + "name = 'a/b'", "capture 1: name: expected letters"),
        (CAPTURE + "name = 'batch'", "capture 1: name: 'batch': batch.json in .* belongs to the batch itself"),
        (CAPTURE + "name = 'jobs'", "capture 1: name: 'jobs': jobs in .* belongs to the batch itself"),
        (CAPTURE + "name = 'table.md'", "capture 1: name: 'table.md': table.md in .* belongs to the batch itself"),
        (CAPTURE + CAPTURE, "capture 2: name: 'kitchen': kitchen in .* belongs to capture 1, 'kitchen'; give"),
        (CAPTURE + CAPTURE + "name = 'kitchen.evaluation'", "kitchen.evaluation.json in .* belongs to capture 1"),
        (CAPTURE + "name = 'kitchen.r5dgs'\n" + CAPTURE, "kitchen.r5dgs in .* belongs to capture 1"),
        (CAPTURE + CAPTURE + "name = 'Kitchen'", "Kitchen in .* belongs to capture 1, 'kitchen'"),
        ("[defaults]\ndata = 'kitchen'\n" + CAPTURE, "defaults: unknown key 'data'"),
    ],
)
def test_faults_are_named_with_their_place(written, text, complaint):
    with pytest.raises(ConfigError, match=complaint) as caught:
        captures.read(written(text))
    assert "captures.toml: " in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match="none.toml: cannot be read"):
        captures.read(tmp_path / "none.toml")
