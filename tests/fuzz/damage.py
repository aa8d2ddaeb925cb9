"""Damaged text files, and undamaged crate files and packages."""

import random
import re
import zipfile
from pathlib import Path

from pxr import Sdf

NUMBERS = (
    b"nan",
    b"-nan",
    b"inf",
    b"1e400",
    b"-0",
    b"1e-310",
    b"0x10",
    b"--1",
    b"99999999999999999999",
    b"1.",
    b".5",
    b"",
)
WORDS = (b"{", b"}", b"(", b")", b"[", b"]", b'"', b"'", b"@", b"<", b">", b"#", b'"""', b"@@@", b"None", b"def", b"\\")
ODD = (b"\xff\xfe", b"\x00", b"\xc3\x28", b"\xed\xa0\x80", "\u202e".encode(), b"\r", b"\x1b[31m")


def spoil_text(path: Path, chance: random.Random) -> str:
    """Damage the text of a stage in place; return what was done."""
    done = []
    for _ in range(chance.choice((1, 1, 2, 5))):
        data = path.read_bytes()
        what = chance.choice(_TEXT)
        path.write_bytes(what(data, chance))
        done.append(what.__name__)
    return " ".join(done)


def to_crate(layer: Sdf.Layer, path: Path) -> Path:
    """Write a stage that lies at ``path`` as a crate file beside it."""
    target = path.with_suffix(".usdc")
    layer.Export(str(target))
    return target


def to_package(layer: Sdf.Layer, path: Path, chance: random.Random) -> Path:
    """Pack a stage, as USD wants it or not quite: compressed, not aligned, the stage not first, nested."""
    inner = chance.choice((path, to_crate(layer, path)))
    target = path.with_suffix(".usdz")
    with zipfile.ZipFile(target, "w", chance.choice((zipfile.ZIP_STORED,) * 3 + (zipfile.ZIP_DEFLATED,))) as package:
        if chance.random() < 0.2:
            package.writestr("note.txt", "hello")
        entry = zipfile.ZipInfo(chance.choice((inner.name,) * 3 + ("../" + inner.name, "a/" + inner.name)))
        entry.compress_type = package.compression
        if chance.random() < 0.8:  # data begins at a multiple of 64 bytes
            header = package.fp.tell() + 30 + len(entry.filename) + 4
            entry.extra = (0x1986).to_bytes(2, "little") + (pad := -header % 64).to_bytes(2, "little") + bytes(pad)
        package.writestr(entry, inner.read_bytes())
    return target


def cut(data, chance):
    """End in the midst."""
    return data[: chance.randrange(len(data) + 1)]


def garble(data, chance):
    """Change bytes."""
    changed = bytearray(data)
    for _ in range(min(len(data), chance.choice((1, 3, 30)))):
        changed[chance.randrange(len(data))] = chance.randrange(256)
    return bytes(changed)


def insert(data, chance):
    """Insert a word or bytes that no text has."""
    place = chance.randrange(len(data) + 1)
    return data[:place] + chance.choice((*WORDS, *ODD)) + data[place:]


def lengthen(data, chance):
    """Insert a very long line."""
    place = chance.randrange(len(data) + 1)
    return data[:place] + chance.choice((b" ", b"x", b"(", b"[", b"1, ", b'"', b"{")) * 100_000 + data[place:]


def renumber(data, chance):
    """Put another number in the place of one."""
    numbers = list(re.finditer(rb"(?<![\w.])-?\d[\d.e+-]*", data))
    if not numbers:
        return data
    number = chance.choice(numbers)
    return data[: number.start()] + chance.choice(NUMBERS) + data[number.end() :]


def drop(data, chance):
    """Lose a line."""
    lines = data.split(b"\n")
    del lines[chance.randrange(len(lines))]
    return b"\n".join(lines)


def repeat(data, chance):
    """Say lines twice."""
    lines = data.split(b"\n")
    first = chance.randrange(len(lines))
    some = lines[first : first + chance.choice((1, 3, 20))]
    return b"\n".join([*lines[:first], *some, *lines[first:]])


def retype(data, chance):
    """Put another word in the place of one."""
    words = list(re.finditer(rb"\b[A-Za-z_:]{3,}\b", data))
    if not words:
        return data
    word, other = chance.choice(words), chance.choice(words)
    return data[: word.start()] + other.group() + data[word.end() :]


_TEXT = (cut, garble, garble, insert, insert, lengthen, renumber, renumber, renumber, drop, repeat, retype, retype)
