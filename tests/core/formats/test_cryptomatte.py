"""Cryptomatte names have the same hashes as in other programs."""

import json

import numpy as np
import pytest

from r5dgs_core.formats import cryptomatte


@pytest.mark.parametrize(
    ("name", "expected"),
    # Known values of MurmurHash3_x86_32 with seed 0, the last four from a manifest that Cycles wrote.
    [("test", 0xBA6BD213), ("Hello, world!", 0xC0363E43), ("abc", 0xB3DD93FA), ("aa", 0x371091A9)]
    + [("abcdef", 0x6181C085), ("mug anchor", 0x4A164AF0), ("Äpfel", 0x91880856)],
)
def test_hashes_are_murmur3(name, expected):
    assert cryptomatte.hash_of(name) == expected


def test_every_value_is_a_finite_normal_number_with_the_hashs_bits():
    names = [f"object {k}" for k in range(5000)]
    values = np.array([cryptomatte.value_of(name) for name in names])
    assert np.isfinite(values).all() and (np.abs(values) >= np.finfo(np.float32).tiny).all()
    assert values.view(np.uint32).tolist() == [cryptomatte.hash_of(name) for name in names]
    raw = [cryptomatte._murmur3(name.encode()) for name in names]
    changed = sum(a != cryptomatte.hash_of(name) for a, name in zip(raw, names, strict=True))
    assert 0 < changed < 200  # two exponents of 256


def test_a_manifest_finds_the_values_of_an_image():
    found = cryptomatte.metadata("ViewLayer.CryptoObject", ["mug", "red apple", 'Äpfel "1"'])
    keys = {key.rsplit("/", 1)[1]: text for key, text in found.items()}
    assert keys["name"] == "ViewLayer.CryptoObject" and keys["conversion"] == "uint32_to_float32"
    (start,) = {key.rsplit("/", 1)[0] for key in found}
    assert start == f"cryptomatte/{cryptomatte.hash_of('ViewLayer.CryptoObject'):08x}"[:19]
    names = json.loads(keys["manifest"])
    assert np.uint32(int(names["red apple"], 16)).view(np.float32) == cryptomatte.value_of("red apple")
    assert len(names) == 3
