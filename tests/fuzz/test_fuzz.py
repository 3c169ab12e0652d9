"""Hundreds of mutated inputs per run, and tests that the campaign detects defects."""

import mmap
import time
from random import Random

import pytest

from r5dgs_core import errors
from tests.fuzz import campaign, mutations, readers

pytestmark = pytest.mark.heavy

INPUTS = 400


@pytest.mark.parametrize("name", list(readers.READERS))
def test_mutated_files_are_accepted_and_work_or_are_refused_with_one_error(name, tmp_path):
    count = max(30, INPUTS * readers.SHARES[name] // sum(readers.SHARES.values()))
    tally = campaign.run(readers.READERS[name](), range(count), seed=0, save=tmp_path)
    assert tally.good, f"{campaign.HEAD}\n{tally.row()}\n{dict(tally.faults)}; inputs are in {tmp_path}"
    assert tally.refused > 0.1 * count and (tally.accepted > 0 or count < 100)


def campaign_of(read, tmp_path):
    reader = campaign.Reader("made", lambda random: {"a": random.randbytes(4)}, read)
    return campaign.run(reader, range(2), seed=1, save=tmp_path)


def test_a_defect_is_counted_and_its_input_is_kept(tmp_path):
    tally = campaign_of(lambda folder: [][1], tmp_path)
    assert not tally.good and tally.uncaught == 2 and "IndexError" in next(iter(tally.faults))
    kept = tmp_path / "made-1-0"
    assert (kept / "a").read_bytes() == Random("1/made/0").randbytes(4)
    assert "IndexError" in (kept / "traceback.txt").read_text()


def test_a_refusal_is_no_defect(tmp_path):
    def refuse(folder):
        raise errors.DatasetError("a: expected b")

    tally = campaign_of(refuse, tmp_path)
    assert tally.good and tally.refused == 2 and not list(tmp_path.iterdir())


def test_a_hang_is_ended_and_counted_whatever_the_reader_catches(tmp_path, monkeypatch):
    monkeypatch.setattr(campaign, "MAX_SECONDS", 0.1)

    def hang(folder):
        while True:
            try:
                time.process_time()
            except Exception:
                continue

    tally = campaign_of(hang, tmp_path)
    assert not tally.good and tally.hangs == 2


def test_memory_is_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(campaign, "MAX_MEMORY", 20 << 20)
    # New pages: the heap of a long test session may have room for the rest.
    tally = campaign_of(lambda folder: mmap.mmap(-1, 100 << 20).write(bytes(100 << 20)), tmp_path)
    assert not tally.good and tally.peak > 40 << 20


def test_inputs_follow_from_seed_and_index(tmp_path):
    reader = readers.READERS["config"]()
    assert reader.make(Random("0/config/3")) == reader.make(Random("0/config/3"))
    assert len({str(reader.make(Random(f"0/config/{index}"))) for index in range(20)}) > 15


@pytest.mark.parametrize("change", [mutations.data, mutations.text, mutations.tree])
def test_mutations_change_their_input(change):
    content = b'{"a": [1, 2.5], "b": {"c": "text"}}'
    assert sum(change(Random(seed), content) != content for seed in range(50)) > 35
