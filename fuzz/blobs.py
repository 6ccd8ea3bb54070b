"""Mutations of bytes and of text that know no format."""

from __future__ import annotations

import re
import struct
from random import Random

NUMBERS = (
    *(
        "0",
        "-1",
        "1",
        "2",
        "-0.0",
        "0.5",
        "255",
        "256",
        "65536",
        "2147483647",
        "2147483648",
        "4294967295",
    ),
    *(
        "9223372036854775807",
        "18446744073709551616",
        "1e-310",
        "5e-324",
        "1e-30",
        "1e9",
        "1e19",
        "1e38",
        "1e300",
    ),
    *(
        "1e308",
        "1e999",
        "-1e999",
        "nan",
        "NaN",
        "inf",
        "-Infinity",
        "0x10",
        "0x_",
        "1_000",
        "1:30",
        "9" * 400,
    ),
)
"""Numbers as text that parsers stumble over."""

TEXTS = (
    *(
        "",
        " ",
        ".",
        "..",
        "/",
        "//",
        "../../precious/keep.txt",
        "/dev/null",
        "/dev/zero",
        "~",
        "~root/x",
        "a\x00b",
    ),
    *(
        "\x1b[31mred\x1b[0m",
        "two\nlines",
        "tab\there",
        "caf\u00e9",
        "\u2028",
        "\u202eevil",
        "\ud800",
        "\U0001f600",
    ),
    *(
        "x" * 300,
        "a/" * 600,
        "%s%n",
        "{0}",
        "{x.__class__}",
        "CON",
        "-rf",
        "*",
        "images/",
        "./.",
        ".dyngs_frames/z/f.png",
    ),
)
"""Texts that readers stumble over."""

_LATIN = ("caf\xe9".encode("latin-1"), b"\xff\xfe", b"\x80", b"\x1b[2J", b"\n", b"../../x", b"\0")
_INTEGERS = {
    1: (0, 1, 2, 0x7F, 0x80, 0xFF),
    2: (0, 1, 0x7FFF, 0x8000, 0xFFFF, 256),
    4: (0, 1, 2, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x10000, 0x00FFFFFF, 20000),
    8: (0, 1, 2**31, 2**32, 2**61, 2**62, 2**63 - 1, 2**63, 2**64 - 1, 2**40),
}
_FLOATS = (
    0.0,
    -0.0,
    -1.0,
    float("nan"),
    float("inf"),
    float("-inf"),
    1e300,
    1e-310,
    3e38,
    1e19,
    1e-30,
)


def bytes_changed(data: bytes, rng: Random) -> bytes:
    """Return ``data`` after one random mutation that knows nothing of its format."""
    if not data:
        return rng.choice((b"\0", b"{}", b"\xff" * 9))
    change = rng.choice(
        (
            _flipped,
            _flipped,
            _integer,
            _integer,
            _float,
            _cut,
            _doubled,
            _removed,
            _inserted,
            _zeroed,
        )
    )
    return change(data, rng)


def head_changed(data: bytes, rng: Random, size: int = 300) -> bytes:
    """Mutate as ``bytes_changed`` within the first ``size`` bytes, where headers are."""
    return bytes_changed(data[:size], rng) + data[size:]


def strings_changed(data: bytes, rng: Random) -> bytes:
    """Return ``data`` with one run of printable characters replaced."""
    runs = list(re.finditer(rb"[\x20-\x7e]{3,}", data))
    if not runs:
        return bytes_changed(data, rng)
    run = rng.choice(runs)
    new = rng.choice((*_LATIN, *(text.encode("utf-8", "surrogatepass") for text in TEXTS)))
    if rng.random() < 0.5:
        # of the same length, so that what follows stays in place
        new = (new + run[0])[: len(run[0])]
    return data[: run.start()] + new + data[run.end() :]


def text_changed(data: bytes, rng: Random) -> bytes:
    """Return text with a number, a word or a line changed."""
    text = data.decode("utf-8", "surrogateescape")
    change = rng.choice((_number, _number, _number, _word, _word, _line, _line))
    return change(text, rng).encode(
        "utf-8", "surrogateescape" if "\ud800" not in text else "surrogatepass"
    )


def _number(text: str, rng: Random) -> str:
    found = list(re.finditer(r"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?", text))
    if not found:
        return _word(text, rng)
    number = rng.choice(found)
    return text[: number.start()] + rng.choice(NUMBERS) + text[number.end() :]


def _word(text: str, rng: Random) -> str:
    found = list(re.finditer(r"[^\s,:=\[\]{}]+", text))
    if not found:
        return text + rng.choice(NUMBERS)
    word = rng.choice(found)
    other = rng.choice((rng.choice(NUMBERS), _sayable(rng.choice(TEXTS)), rng.choice(found)[0]))
    return text[: word.start()] + other + text[word.end() :]


def _line(text: str, rng: Random) -> str:
    lines = text.splitlines(keepends=True)
    if not lines:
        return "\n"
    i = rng.randrange(len(lines))
    j = rng.randrange(len(lines))
    change = rng.randrange(4)
    if change == 0:
        del lines[i]
    elif change == 1:
        lines.insert(i, lines[j])
    elif change == 2:
        lines[i], lines[j] = lines[j], lines[i]
    else:
        lines[i] = lines[i] * rng.choice((2, 50))
    return "".join(lines)


def _sayable(text: str) -> str:
    return text.replace("\ud800", "\udcff")  # comes out as the byte 0xff


def _flipped(data: bytes, rng: Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 3, 10))):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _integer(data: bytes, rng: Random) -> bytes:
    size = rng.choice([n for n in _INTEGERS if n <= len(data)])
    value = rng.choice(_INTEGERS[size])
    at = rng.randrange(len(data) - size + 1)
    return data[:at] + value.to_bytes(size, rng.choice(("little", "big"))) + data[at + size :]


def _float(data: bytes, rng: Random) -> bytes:
    kind = rng.choice(("<f", "<d", ">f", ">d"))
    value = rng.choice(_FLOATS)
    if kind[1] == "f" and abs(value) > 3.4e38:
        value = float("inf")
    new = struct.pack(kind, value)
    at = rng.randrange(max(len(data) - len(new), 0) + 1) // len(new) * len(new)
    return data[:at] + new + data[at + len(new) :]


def _cut(data: bytes, rng: Random) -> bytes:
    return data[: rng.randrange(len(data))]


def _part(data: bytes, rng: Random) -> tuple[int, int]:
    begin = rng.randrange(len(data))
    return begin, min(len(data), begin + rng.choice((1, 2, 4, 8, 16, 64, 256)))


def _doubled(data: bytes, rng: Random) -> bytes:
    begin, end = _part(data, rng)
    return data[:end] + data[begin:end] * rng.choice((1, 1, 20)) + data[end:]


def _removed(data: bytes, rng: Random) -> bytes:
    begin, end = _part(data, rng)
    return data[:begin] + data[end:]


def _zeroed(data: bytes, rng: Random) -> bytes:
    begin, end = _part(data, rng)
    return data[:begin] + rng.choice((b"\0", b"\xff")) * (end - begin) + data[end:]


def _inserted(data: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice((*_LATIN, b"\xff" * 8, rng.randbytes(5))) + data[at:]
