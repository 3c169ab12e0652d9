"""The cache of arrays stays within its limit, and gives what the reader gives."""

import errno
import mmap
import os
import pickle
import threading

import numpy as np
import pytest

from r5dgs_core.data.array_cache import AHEAD, LARGE, ArrayCache, CachedArray
from tests.support import patience, processes

# Code that prints the MB which 200 MB of arrays leave, between which small blocks of memory lie.
DROPS = """
import numpy as np
from r5dgs_core.data.array_cache import ArrayCache

def resident():
    line = next(line for line in open("/proc/self/status") if line.startswith("VmRSS"))
    return int(line.split()[1]) // 1024

cache, small = ArrayCache(1e9), []
cache.get(-1, lambda: np.ones(4 * 2**20, np.uint8))
cache.clear()
before = resident()
for key in range(100):
    cache.get(key, lambda: np.ones(2 * 2**20, np.uint8))
    small.append(np.ones(100_000, np.uint8))
cache.clear()
print(resident() - before - len(small) // 10)
"""


class Reader:
    """Reads arrays of 100 bytes and counts how often."""

    def __init__(self):
        self.counts = {}

    def of(self, key):
        def read():
            self.counts[key] = self.counts.get(key, 0) + 1
            return np.full(100, key, np.uint8)

        return read


def test_arrays_are_read_once_while_they_fit():
    cache, reader = ArrayCache(1000), Reader()
    for key in [0, 1, 2] * 3:
        assert (cache.get(key, reader.of(key)) == key).all()
    assert reader.counts == {0: 1, 1: 1, 2: 1}


def test_the_limit_holds_and_the_least_recently_used_array_is_dropped():
    cache, reader = ArrayCache(250), Reader()
    for key in (0, 1, 0, 2):
        cache.get(key, reader.of(key))
        assert cache.nbytes <= 250
    assert cache.peek(1) is None
    assert cache.peek(0) is not None


def test_an_array_larger_than_the_limit_is_kept_until_the_next_one():
    cache, reader = ArrayCache(10), Reader()
    for _ in range(3):
        cache.get(0, reader.of(0))
    cache.get(1, reader.of(1))
    assert (reader.counts[0], cache.nbytes) == (1, 100)


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="needs /proc")
def test_dropped_arrays_leave_no_memory_behind():
    ended = processes.run(DROPS)
    assert ended.returncode == 0, ended.stderr
    assert int(ended.stdout) < 20


@pytest.mark.parametrize("order", ["C", "F"])
def test_large_arrays_may_be_written_and_pickled(order):
    array = np.asarray(np.arange(LARGE).reshape(2, -1), order=order)
    found = ArrayCache(1e9).get(0, lambda: array)
    np.testing.assert_array_equal(found, array)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(found)), array)
    found[0, 0] = 7
    assert found[0, 0] == 7


def test_a_system_without_pages_for_an_array_is_no_error(monkeypatch):
    def refuse(*given, **named):
        raise OSError(errno.ENOMEM, "no pages")

    monkeypatch.setattr(mmap, "mmap", refuse)
    array = np.ones(LARGE, np.uint8)
    assert ArrayCache(1e9).get(0, lambda: array) is array


def test_expected_arrays_are_read_in_the_background_and_once():
    cache, reader, names = ArrayCache(1000), Reader(), []

    def read():
        names.append(threading.current_thread().name)
        return reader.of(7)()

    cache.expect(7, read)
    assert (cache.get(7, read) == 7).all()
    cache.get(7, read)
    assert reader.counts == {7: 1}
    assert names[0].startswith("r5dgs-images")


def test_few_arrays_are_read_ahead():
    cache, gate, ahead = ArrayCache(1000), threading.Event(), []

    def read(key):
        ahead.append(key)
        gate.wait(patience.PATIENCE_S)
        return np.full(100, key, np.uint8)

    for key in range(10):
        cache.expect(key, lambda key=key: read(key))
    gate.set()
    for key in range(10):
        assert (cache.get(key, lambda key=key: np.full(100, key, np.uint8)) == key).all()
    assert sorted(ahead) == list(range(2 * AHEAD))


def test_arrays_that_were_expected_in_vain_do_not_stop_reading_ahead():
    cache, reader = ArrayCache(1000), Reader()
    for key in range(2 * AHEAD):
        cache.expect(key, reader.of(key))
    patience.wait_until(lambda: len(reader.counts) == 2 * AHEAD)

    def expected():
        cache.expect(100, reader.of(100))
        return 100 in reader.counts

    patience.wait_until(expected)
    assert cache.nbytes == 100 * 2 * AHEAD


def test_an_error_in_the_background_is_raised_when_the_array_is_used():
    cache = ArrayCache(1000)

    def broken():
        raise OSError("damaged")

    cache.expect(0, broken)
    with pytest.raises(OSError, match="damaged"):
        cache.get(0, broken)
    assert (cache.get(0, lambda: np.ones(3)) == 1).all()


def test_a_lent_part_of_the_limit_is_free_meanwhile():
    cache, reader = ArrayCache(250), Reader()
    cache.get(0, reader.of(0))
    cache.get(1, reader.of(1))
    with cache.lent(200):
        assert cache.nbytes == 100
        cache.get(0, reader.of(0))
        assert cache.nbytes == 100
    cache.get(1, reader.of(1))
    assert cache.nbytes == 200


def test_a_cleared_cache_reads_again():
    cache, reader = ArrayCache(1000), Reader()
    cache.get(0, reader.of(0))
    cache.clear()
    assert cache.nbytes == 0
    cache.get(0, reader.of(0))
    assert reader.counts[0] == 2


@pytest.mark.parametrize("limit", [1000, 100])
def test_a_derived_array_follows_its_source(limit):
    cache, reader = ArrayCache(limit), Reader()
    source = CachedArray(cache, 3, reader.of(3))
    doubled = source.derived("doubled", lambda array: 2 * array)
    source()
    assert (doubled() == 6).all()
    assert (source() == 3).all()
    assert (doubled() == 6).all()
