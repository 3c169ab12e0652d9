import json
import tracemalloc

import pytest

from r5dgs_core import errors, strict_json


def parse(text, **options):
    data = text if isinstance(text, bytes) else text.encode()
    return strict_json.parse(data, "file.json", errors.DatasetError, **options)


@pytest.mark.parametrize(
    "value",
    [None, True, 0, -(1 << 63), (1 << 63) - 1, 1.5e308, 5e-324, "", "é 😀 \n\0", [], {}, {"a": [1, {"b": None}]}],
)
def test_accepted_values_are_those_of_json_and_can_be_written_again(value):
    for text in (json.dumps(value), json.dumps(value, ensure_ascii=False)):
        assert parse(text) == value
        assert parse(json.dumps(parse(text), allow_nan=False)) == value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1, column 1"),
        ('{"a": 1,\n "b": }', "line 2, column 7"),
        (b"\xff\xfe", "damage"),
        ("NaN", "finite numbers, found NaN"),
        ("[1,\n-Infinity]", "-Infinity .line 2"),
        ("1e400", "1e400 is out of range"),
        ("9223372036854775808", "64 bits"),
        ("9" * 400, "64 bits"),
        ("-" + "9" * 6000, "64 bits"),
        ("[" * 100_000, "nested deeper"),
        ("[" * 70 + "]" * 70, "nested deeper than 64"),
        ('{"a": ' * 66 + "1" + "}" * 66, "nested deeper than 64"),
        ('{"a": 1, "b": {"c": 2, "c": 3}}', "'c' occurs twice"),
        ('{"name": "\\ud83d"}', "surrogate"),
        ('{"\\uDE00": 1}', "surrogate"),
    ],
)
def test_each_fault_is_one_error_of_the_kind_asked_for(text, message):
    with pytest.raises(errors.DatasetError, match=message) as caught:
        parse(text)
    assert str(caught.value).startswith("file.json: ")
    assert len(str(caught.value)) < 300


def test_a_duplicate_key_is_found_in_linear_time():
    class Counted(str):
        compared = 0

        def __eq__(self, other):
            Counted.compared += 1
            return str.__eq__(self, other)

        __hash__ = str.__hash__

    pairs = [(Counted(i), i) for i in range(3000)]
    with pytest.raises(ValueError, match="'z' occurs twice"):
        strict_json._object([*pairs, (Counted("z"), 0), (Counted("z"), 1)])
    assert Counted.compared < 10 * len(pairs)


def test_nesting_up_to_the_limit_is_accepted():
    parse("[" * strict_json.MAX_DEPTH + "]" * strict_json.MAX_DEPTH)


@pytest.mark.parametrize("unit", [b"[],", b"{},", b'{"a":0},', b"0,", b"[[]],", b'"ab",'])
def test_refused_input_takes_less_memory_than_the_limit(unit):
    limit, text = 1 << 20, b"[" + unit * 200_000 + b"0]"
    tracemalloc.start()
    try:
        with pytest.raises(errors.DatasetError, match="MiB of memory"):
            parse(text, memory=limit)
        assert tracemalloc.get_traced_memory()[1] < limit
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("unit", [b"[],", b"{},", b'{"a":0},', b"0,", b"[[]],", b"1.5,", b"12345,"])
def test_the_estimate_of_memory_is_an_upper_bound(unit):
    text = b"[" + unit * 20_000 + b"0]"
    tracemalloc.start()
    try:
        content = parse(text)
        assert tracemalloc.get_traced_memory()[0] < strict_json.memory_of(text) + 100_000
    finally:
        tracemalloc.stop()
    assert len(content) == 20_001


def test_a_file_is_not_read_past_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(strict_json, "MAX_BYTES", 100)
    path = tmp_path / "large.json"
    path.write_bytes(b" " * 1000 + b"1")
    with pytest.raises(errors.ConfigError, match="large.json: expected JSON of at most"):
        strict_json.read(path, errors.ConfigError)
    path.write_bytes(b" " * 98 + b"12")
    assert strict_json.read(path, errors.ConfigError) == 12


def test_missing_files_and_folders_are_named(tmp_path):
    with pytest.raises(errors.ConfigError, match="missing"):
        strict_json.read(tmp_path / "gone.json", errors.ConfigError)
    with pytest.raises(errors.ConfigError, match="cannot be read"):
        strict_json.read(tmp_path, errors.ConfigError)
