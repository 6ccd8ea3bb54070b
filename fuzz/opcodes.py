"""Mutations of pickles, opcode by opcode."""

from __future__ import annotations

import pickletools
from random import Random

from fuzz.blobs import bytes_changed

_NAMES = (
    *(
        b"numpy\nndarray",
        b"numpy\ndtype",
        b"numpy.core.multiarray\n_reconstruct",
        b"numpy.core.multiarray\nscalar",
    ),
    *(
        b"numpy._core.multiarray\n_reconstruct",
        b"numpy.core.numeric\n_frombuffer",
        b"builtins\ngetattr",
        b"os\nsystem",
    ),
    *(
        b"functools\npartial",
        b"collections\nOrderedDict",
        b"scipy.sparse.csc\ncsc_matrix",
        b"chumpy.ch\nCh",
    ),
    *(
        b"copy_reg\n_reconstructor",
        b"_codecs\nencode",
        b"builtins\nobject",
        b"builtins\nbytearray",
        b"builtins\nset",
    ),
    *(b"scipy.sparse._csr\ncsr_matrix", b"builtins\neval", b"builtins\ncomplex", b"\xff\n\xff"),
)
_GLOBALS = tuple(b"c" + name + b"\n" for name in _NAMES)
_VALUES = (
    *(
        b"N",
        b"\x88",
        b"]",
        b"}",
        b")",
        b"\x8f",
        b"K\x05",
        b"J\xff\xff\xff\xff",
        b"G\x7f\xf8\0\0\0\0\0\0",
        b"(t",
        b"(l",
    ),
    *(
        b"\x8a\x09" + b"\xff" * 9,
        b"\x8b\xff\xff\xff\x7f",
        b"\x96" + (2**32).to_bytes(8, "little"),
        b"U\x01a",
        b"T\0\0\0\x80",
    ),
    *(
        b"X\xff\xff\xff\x7f",
        b"\x8d" + b"\xff" * 8,
        b"S'x'\n",
        b"I" + b"9" * 5000 + b"\n",
        b"Fnan\n",
        b"V\\ud800\n",
    ),
    *(b"r\xff\xff\xff\x7f", b"j\xff\xff\xff\x7f", b"h\xff", b"q\x00", b"L1e5L\n"),
)
_ACTIONS = (
    b"b",
    b"R",
    b"\x81",
    b"\x92",
    b"i",
    b"o",
    b"a",
    b"e",
    b"s",
    b"u",
    b"0",
    b"1",
    b"2",
    b"(",
    b"t",
    b"\x85",
    b"\x86",
)
_ACTIONS += (
    b"\x87",
    b"\x90",
    b"\x91",
    b"\x93",
    b"\x94",
    b"Q",
    b"P1\n",
    b"\x97",
    b"\x98",
    b".",
    b"\x95" + bytes(8),
)
_HOSTILE = (
    b"\x80\x04)" + b"\x85" * 200_000 + b"}\x942\x94s.",
    b"\x80\x02)" + b"2\x86" * 40 + b".",
    b"\x80\x02}" + b")2\x86" * 30 + b"K\x01s.",
    b"\x80\x05\x96" + (2**32).to_bytes(8, "little") + b".",
    b"\x80\x02cfunctools\npartial\n)\x81(NNNNtb.",
    b"\x80\x02cscipy.sparse.csc\ncsc_matrix\n)\x81}(U\x06_shapeJ\0\0\0\x04K\x01\x86u" + b"b.",
    b"\x80\x02]" + b"2a" * 3 + b".",
    b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b".",
)
"""Pickles that keep readers busy, fill memory or end the process where they are trusted."""


def pickle_changed(data: bytes, rng: Random) -> bytes:
    """Return a pickle after one mutation of its opcodes."""
    if rng.random() < 0.04:
        return rng.choice(_HOSTILE)
    if rng.random() < 0.15:
        return bytes_changed(data, rng)
    codes = _codes(data)
    if len(codes) < 2:
        return bytes_changed(data, rng)
    i = rng.randrange(len(codes))
    j = rng.randrange(len(codes))
    change = rng.randrange(7)
    if change == 0:
        del codes[i]
    elif change == 1:
        codes.insert(i, codes[j])
    elif change == 2:
        codes[i] = codes[j]
    elif change == 3:
        codes[i] = _argument_changed(codes[i], rng)
    elif change == 4:
        codes.insert(i, rng.choice(_ACTIONS))
    elif change == 5:
        codes.insert(i, rng.choice(_VALUES))
    else:
        places = [k for k, code in enumerate(codes) if code[:1] == b"c"] or [i]
        codes[rng.choice(places)] = rng.choice(_GLOBALS)
    return b"".join(codes)


def _codes(data: bytes) -> list[bytes]:
    """Split a pickle into opcodes with arguments as far as possible, without frames, which count
    bytes."""
    codes: list[bytes] = []
    starts: list[int] = []
    names: list[str] = []
    try:
        for code, _, at in pickletools.genops(data):
            starts.append(at or 0)
            names.append(code.name)
    except Exception:  # damaged already
        starts.append(len(data))
        names.append("")
    starts.append(len(data))
    for name, begin, end in zip(names, starts, starts[1:], strict=False):
        if name != "FRAME" and end > begin:
            codes.append(data[begin:end])
    return codes


def _argument_changed(code: bytes, rng: Random) -> bytes:
    """Change the number, the text or the bytes of an opcode's argument."""
    if code[:1] in (b"c", b"\x93"):
        return rng.choice(_GLOBALS)
    return code[:1] + bytes_changed(code[1:], rng) if len(code) > 1 else rng.choice(_VALUES)
