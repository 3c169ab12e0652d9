"""Mutations of bytes, text, JSON, arrays, zips and PNGs. Each takes a `random.Random` and returns new bytes."""

from __future__ import annotations

import copy
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np

NUMBERS = (
    0,
    -1,
    1,
    0.5,
    -0.0,
    1e-320,
    1e-12,
    3e38,
    -3e38,
    1e15,
    1e19,
    1e200,
    1e308,
    -1e308,
    255,
    65536,
    2**31,
    2**53,
    2**63 - 1,
)
RAW = (
    *("NaN", "-Infinity", "1e999", "9" * 400, "-" + "9" * 5000, '"\\ud800"', '"a\\u0000b"', '"' + "x" * 5000 + '"'),
    *("[" * 90 + "]" * 90, "[" * 30000, '{"a": 1, "a": 2}', '{"kind": {"kind": []}}', "[[1, 2], [3]]", "[null]"),
    *("{}", "[]", "null", "true", '""', '"1"', '"../../x"', '"\\u001b[31m"', "[true, false, 0.5]"),
    "[1e308, 1e308, 1e308]",
)
WORDS = (
    *(
        "",
        "0",
        "-1",
        "1",
        "nan",
        "inf",
        "-inf",
        "1e999",
        "1e308",
        "3e38",
        "1e-320",
        "9" * 30,
        "9" * 5000,
        "1_0",
        "0x10",
    ),
    *("²", "true", "[]", "{}", "[" * 500, "(" * 150, "[" * 3000, "\x00", "\ud800", "é", "'", '"', '"""', "[[1],2]"),
    *("1979-05-27", "99:99:99", "{a=1}", "#", "4294967296", "18446744073709551615", "list", "double"),
    *("element vertex 1000000000000", "../..", "a" * 300, "-" * 2000),
)
SHAPES = (
    *("()", "(0,)", "(-1, 3)", "(True, 3)", "(1000000000000, 3)", "(3, -4)", "(" + "9" * 400 + ",)", "(2, 3", "[2, 3]"),
    *("None", "(1e3,)", "(2**62, 4)", "(" + "1, " * 70 + ")", "(" * 90 + ")" * 90, "'a'", "{}", "(2, 'x')"),
    "(0, 1000000000000)",
)
EXTREMES = tuple(
    struct.pack(layout, value)
    for layout, value in [
        *(("<d", v) for v in (float("nan"), float("inf"), 1e308, -1e308, 1e19, 0.0, -1.0, 1e-320)),
        *(("<f", v) for v in (float("nan"), float("-inf"), 3e38, -3e38, 1e19, 1e-40)),
        *(("<Q", v) for v in (0, 1, 2**31, 2**40, 2**63, 2**64 - 1)),
        *(("<I", v) for v in (0, 2**31 - 1, 2**32 - 1)),
        *(("<H", v) for v in (0, 0x7FFF, 0xFFFF)),
    ]
)


def data(random: Random, content: bytes) -> bytes:
    """Flip, overwrite, cut, insert, repeat or shorten bytes, once or a few times."""
    result = bytearray(content)
    for _ in range(random.choice((1, 1, 1, 2, 8))):
        at, length = random.randrange(len(result) + 1), random.choice((1, 1, 4, 16, 200))
        kind = random.randrange(7)
        if kind == 0 and at < len(result):
            result[at] ^= 1 << random.randrange(8)
        elif kind == 1:
            result[at : at + length] = random.randbytes(length)
        elif kind == 2:
            del result[at : at + length]
        elif kind == 3:
            result[at:at] = random.randbytes(length)
        elif kind == 4:
            result[at:at] = result[at : at + length]
        elif kind == 5:
            extreme = random.choice(EXTREMES)
            result[at : at + len(extreme)] = extreme
        elif random.random() < 0.3:
            del result[at:]
    return bytes(result)


def text(random: Random, content: bytes) -> bytes:
    """Change words and lines of a text, or its bytes."""
    kind = random.randrange(10)
    if kind == 0:
        return data(random, content)
    lines = content.decode("latin-1").split("\n")
    at = random.randrange(len(lines))
    if kind == 1:
        del lines[at]
    elif kind == 2:
        lines.insert(at, lines[random.randrange(len(lines))])
    elif kind == 3:
        lines.insert(at, random.choice(WORDS) + " " + random.choice(WORDS))
    else:
        for _ in range(random.choice((1, 1, 2, 4))):
            at = random.randrange(len(lines))
            words = re.split(r"([\s=,()\[\]]+)", lines[at])
            words[random.randrange(len(words))] = random.choice(WORDS)
            lines[at] = "".join(words)
    if random.random() < 0.2:
        return "\n".join(lines).encode("latin-1", "replace")
    return "\n".join(lines).encode("utf-8", "surrogatepass" if random.random() < 0.3 else "replace")


def tree(random: Random, content: bytes) -> bytes:
    """Change values, keys and the structure of JSON, or its text."""
    if random.random() < 0.08:
        return data(random, content)
    root = {"": json.loads(content)}
    raw: list[str] = []
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        places = list(_places(root))
        node, key = random.choice(places)
        value, kind = node[key], random.randrange(12)
        if kind < 4:
            node[key] = random.choice(NUMBERS)
        elif kind < 7:
            raw.append(random.choice(RAW))
            node[key] = f"@RAW{len(raw) - 1}@"
        elif kind == 7 and len(places) > 1:
            del node[key]
            if node is root:
                root[""] = None
        elif kind == 8 and isinstance(value, list) and value:
            value.append(copy.deepcopy(random.choice(value)))
        elif kind == 9:
            other, name = random.choice(places)
            node[key] = copy.deepcopy(other[name])
        elif kind == 10 and isinstance(value, int | float) and not isinstance(value, bool):
            node[key] = value * 10.0 ** random.choice((-30, -9, -3, 3, 9, 30, 100))
        elif isinstance(node, dict) and node is not root:
            node[random.choice(("", "kind", "id", "twice", "x" * 100))] = value
    if random.random() < 0.03:  # below the whole content
        root[""] = json.loads("[" * 200 + "]" * 200)
    result = json.dumps(root[""])
    for number, token in enumerate(raw):
        result = result.replace(f'"@RAW{number}@"', token)
    if random.random() < 0.04 and result.startswith("{"):
        result = '{"name": 1, ' + result[1:]
    return result.encode()


def _places(node: Any) -> Any:
    for key in node if isinstance(node, dict) else range(len(node)):
        yield node, key
        if isinstance(node[key], dict | list):
            yield from _places(node[key])


def npy(random: Random, content: bytes) -> bytes:
    """Change values, dtype, shape or header of an array."""
    kind = random.randrange(14)
    if kind == 0:
        return data(random, content)
    start = 10 + int.from_bytes(content[8:10], "little")
    if kind <= 4:
        header = content[10:start].decode()
        if kind == 1:
            header = text(random, header.encode()).decode("latin-1")
        else:
            shape = random.choice(SHAPES)
            header = re.sub(r"\([0-9, ]*\)", lambda _: shape, header, count=1)
        if kind == 3:
            descr = random.choice(
                ("|O", "<f8", "<c8", "<U9", "|V0", "<M8[s]", "x", "<f", "f4, f4", "<i9", ">f4", "|b1", "<f2")
            )
            header = re.sub(r"'[<>|][a-z][0-9]'", repr(descr), header, count=1)
        encoded = header.encode("utf-8", "replace")
        version = random.choice((b"\x01\x00", b"\x01\x00", b"\x01\x00", b"\x02\x00", b"\x03\x00", b"\x09\x09"))
        return content[:6] + version + (len(encoded) & 0xFFFF).to_bytes(2, "little") + encoded + content[start:]
    array = np.load(io.BytesIO(content))
    array = _changed(random, array, kind)
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, version=(1, 0))
    return stream.getvalue()


def _changed(random: Random, array: np.ndarray, kind: int) -> np.ndarray:
    with np.errstate(all="ignore"):
        if kind <= 8 and array.size:
            array = array.copy()
            for _ in range(random.choice((1, 1, 3))):
                value = random.choice((np.nan, np.inf, 3e38, -3e38, 1e19, 1e15, -1, 0, 1e308, 2**31 - 1, 1e-40))
                row: Any = random.randrange(array.size) if random.random() < 0.8 else slice(None)
                array.reshape(-1)[row] = np.array(value).astype(array.dtype)
            return array
        if kind == 9:
            return array * np.array(
                random.choice((0, -1, 1e-30, 1e9, 1e30)), array.dtype if array.dtype.kind == "f" else float
            )
        if kind == 10:
            return array[: random.randrange(len(array) + 1)] if array.ndim else array
        if kind == 11:
            return np.array(array.reshape(-1)[0]) if array.size else array[None]
        if kind == 12:
            return random.choice(
                (array[None], array.reshape(-1), np.asfortranarray(array), np.concatenate([array, array]))
            )
        return array.astype(random.choice(("<f2", "<f4", "<f8", "<i2", "<i4", ">f4", "|u1", "<c8", "|b1")))


def archive(random: Random, members: dict[str, bytes], *, text_member: str) -> bytes:
    """Change one member of a zip, or the zip itself."""
    members, kind = dict(members), random.randrange(20)
    compression, extra = zipfile.ZIP_STORED if random.random() < 0.7 else zipfile.ZIP_DEFLATED, None
    name = random.choice(list(members))
    if kind < 8:
        members[text_member] = tree(random, members[text_member])
    elif kind < 15:
        name = random.choice([other for other in members if other.endswith(".npy")])
        members[name] = npy(random, members[name])
    elif kind == 15:
        del members[name]
    elif kind == 16:
        extra = name
    elif kind == 17:
        compression = random.choice((zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    elif kind == 18:
        members = members | {
            f"{i}{random.choice(WORDS)[:50]}".encode("utf-8", "replace").decode(): b""
            for i in range(random.choice((1, 3000)))
        }
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as file:
        for member, content in members.items():
            file.writestr(member, content)
        if extra:
            file.writestr(extra, members[extra])
    result = stream.getvalue()
    if kind == 19:
        result = sizes(random, result) if random.random() < 0.5 else data(random, result)
    return result


def sizes(random: Random, content: bytes) -> bytes:
    """Change a number in one of a zip's headers."""
    result = bytearray(content)
    starts = [match.start() for match in re.finditer(rb"PK(\x01\x02|\x03\x04|\x05\x06)", content)]
    if starts:
        at = random.choice(starts) + random.choice((4, 6, 8, 10, 14, 16, 18, 20, 22, 24, 26, 28, 30, 42))
        extreme = random.choice(EXTREMES)
        result[at : at + len(extreme)] = extreme
    return bytes(result)


def png(random: Random, content: bytes) -> bytes:
    """Change fields of chunks with checksums that fit, or bytes."""
    if random.random() < 0.3:
        return data(random, content)
    chunks, at = [], 8
    while at + 12 <= len(content):
        (length,) = struct.unpack(">I", content[at : at + 4])
        chunks.append([content[at + 4 : at + 8], content[at + 8 : at + 8 + length]])
        at += 12 + length
    for _ in range(random.choice((1, 1, 2))):
        chunk, kind = random.choice(chunks), random.randrange(8)
        head = next((each for each in chunks if each[0] == b"IHDR" and len(each[1]) == 13), None)
        if kind < 4 and head is not None:
            fields = list(struct.unpack(">IIBBBBB", head[1]))
            field = random.randrange(7)
            fields[field] = (
                random.choice((0, 1, 3, 5, 255, 60000, 2**31 - 1))
                if field < 2
                else random.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
            )
            head[1] = struct.pack(">IIBBBBB", *fields)
        elif kind == 4:
            plain = random.choice((b"", bytes(50), random.randbytes(200), bytes(1 << 24), b"\4" * 5000))
            for each in chunks:
                if each[0] == b"IDAT":
                    each[1] = zlib.compress(plain, 9)
        elif kind == 5:
            chunk[1] = data(random, chunk[1])
        elif kind == 6:
            chunks.insert(
                random.randrange(len(chunks)),
                [random.choice((b"PLTE", b"tRNS", b"IDAT", b"iCCP", b"eXIf")), random.randbytes(9)],
            )
        elif len(chunks) > 1:
            chunks.remove(chunk)
    parts = (
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body)) for name, body in chunks
    )
    return content[:8] + b"".join(parts)


def by_name(name: str) -> Callable[[Random, bytes], bytes]:
    """Choose a mutation by the name of a file."""
    for suffix, change in {".json": tree, ".png": png, ".txt": text, ".toml": text, "cfg_args": text}.items():
        if name.endswith(suffix):
            return change
    return data
