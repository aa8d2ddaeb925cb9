"""Crate files (``.usdc``) of many attributes alike, written by hand: USD itself takes 20 µs for each.

A crate file has values first and then its structure, tables that refer to each other by number: tokens, fields (a name
and a reference to a value), sets of fields, paths, and specs (a path and its set). A reference is eight bytes: the type
of a value, and either the value itself or where it lies. Tables are compressed: integers as differences, and all of it
by LZ4, here in the form that leaves everything as it is.

The format: https://github.com/PixarAnimationStudios/OpenUSD, ``pxr/usd/usd/crateFile.cpp`` and ``integerCoding.cpp``.
"""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

BOOL, DOUBLE, STRING, TOKEN, QUATF, VEC3D, VEC3F, DICTIONARY = 1, 9, 10, 11, 17, 23, 24, 31
TOKEN_VECTOR, SPECIFIER, VARIABILITY, TIME_SAMPLES, DOUBLE_VECTOR = 41, 42, 44, 46, 48
"""Types of values, by their numbers in references."""
MAGIC = b"PXR-USDC"
"""What a crate file begins with."""
HEAD = 24
"""Size of what begins the time samples of an attribute, see ``samples.py`` [bytes]."""
CONTENTS = 16
"""Where a crate file says where its table of contents lies [bytes]."""
SECTION, SECTION_NAME = 32, 16
"""Size of an entry of that table, and of the name before the place [bytes]."""
_BOOTSTRAP = 88
_VERSION = bytes((0, 8, 0))
_ARRAY, _INLINED = 1 << 63, 1 << 62
_OVER, _UNIFORM = 1, 1
_ATTRIBUTE, _PRIM, _PSEUDO_ROOT = 1, 6, 7
_NO_FIELD = 0xFFFFFFFF
_PER_SAMPLED = 4
"""Entries of the set of fields of an attribute with samples: type name, default, samples and the end."""


def reference(kind: int, payload: int, flags: int = 0) -> int:
    """Return the reference to a value, which lies at ``payload`` [bytes] or is that, as the flags say."""
    return flags | kind << 48 | payload


@dataclass(frozen=True)
class LayerFile:
    """A layer as a file.

    Attributes:
        values: Its first bytes, which do not say yet where the table of contents lies.
        structure: Its last bytes, as they have to be right behind.
        contents: Where in these the table of contents lies [bytes].
        heads: Where the heads of time samples lie [bytes], one after the other; zeros so far.
        end_code: Where ``endTimeCode`` lies [bytes].
        types: References without a place to values of each attribute with samples, shape [attributes].
    """

    values: bytes
    structure: bytes
    contents: int
    heads: int
    end_code: int
    types: np.ndarray


class OverLayer:
    """A layer that has opinions on attributes and defines no prim.

    Attributes that are to get time samples have the numbers in which they are added. Their defaults are the values of
    the first frame, which has to stand right behind the values of the layer.
    """

    def __init__(self, sizes: np.ndarray):
        """Begin an empty layer.

        Args:
            sizes: Size of a value of each attribute that will get samples [bytes], shape [attributes].
        """
        self._sizes = sizes
        self._types, self._type_fields = list[int](), list[int]()
        self._tokens, self._strings = {";-)": 0}, dict[int, int]()  # a property is told by a token below 0
        self._values, self._end_code = bytearray(_BOOTSTRAP), -1
        self._fields, self._sets = dict[tuple[int, int], int](), dict[tuple[int, ...], int]()
        self._next_set = _PER_SAMPLED * len(sizes)
        self._metadata, self._over = list[int](), self._field("specifier", reference(SPECIFIER, _OVER, _INLINED))
        self._properties: dict[str, list[tuple[int, int]]] = {"/": []}
        self._children: dict[str, list[str]] = {"/": []}
        self._editable, self._vectors = set[str](), dict[tuple[int, ...], int]()

    def set_metadata(self, name: str, value: float | str | dict) -> None:
        """Set what a layer says of itself."""
        found = self._reference_to(value)
        if name == "endTimeCode":
            self._end_code = len(self._values) - 8
        self._metadata.append(self._field(name, found))

    def add_sampled(self, paths: Sequence[str], name: str, type_name: str, kind: int) -> None:
        """Let prims have an attribute that gets time samples, of a name like ``quatf[]`` arrays of values of a kind."""
        type_field = self._field("typeName", self._token_reference(type_name))
        token = self._token(name)
        for number, path in enumerate(paths, len(self._types)):
            self._properties_of(path).append((token, _PER_SAMPLED * number))
        self._types += [reference(kind, 0, _ARRAY if type_name.endswith("[]") else 0)] * len(paths)
        self._type_fields += [type_field] * len(paths)

    def add_vector(self, path: str, name: str, value: np.ndarray) -> None:
        """Let a prim have an attribute of type ``double3`` that does not change, shape [3]."""
        place = self._place(np.asarray(value, dtype="<f8").tobytes())
        fields = (("typeName", self._token_reference("double3")), ("default", reference(VEC3D, place)))
        self._properties_of(path).append((self._token(name), self._set(fields)))

    def add_tokens(self, paths: Iterable[str], name: str, tokens: Sequence[str]) -> None:
        """Let prims have a uniform attribute of type ``token[]``."""
        fields = (
            ("typeName", self._token_reference("token[]")),
            ("variability", reference(VARIABILITY, _UNIFORM, _INLINED)),
            ("default", reference(TOKEN, self._place(_counted(map(self._token, tokens))), _ARRAY)),
        )
        own = self._token(name), self._set(fields)
        for path in paths:
            self._properties_of(path).append(own)

    def make_editable(self, path: str) -> None:
        """Let a prim be no instance any more."""
        self._properties_of(path)
        self._editable.add(path)

    def encode(self) -> LayerFile:
        """Return the file."""
        paths, specs = self._encode_prims()
        heads = self._place(b"")
        start = heads + HEAD * len(self._sizes)
        sections = {
            "FIELDS": self._encode_fields(heads, start),
            "FIELDSETS": self._encode_sets(),
            "PATHS": paths,
            "SPECS": specs,
            "STRINGS": _counted(self._strings),
            "TOKENS": self._encode_tokens(),
        }
        contents, place = [struct.pack("<Q", len(sections))], start
        for name, data in sections.items():
            contents.append(struct.pack("<16sqq", name.encode(), place, len(data)))
            place += len(data)
        struct.pack_into("<8s8s", self._values, 0, MAGIC, _VERSION)
        structure = b"".join([*sections.values(), *contents])
        values = bytes(self._values) + bytes(start - heads)
        types = np.array(self._types, dtype=np.uint64)
        return LayerFile(values, structure, place - start, heads, self._end_code, types)

    # ---------------------------------------------------------------------------------------------------------------

    def _token(self, text: str) -> int:
        return self._tokens.setdefault(text, len(self._tokens))

    def _token_reference(self, text: str) -> int:
        return reference(TOKEN, self._token(text), _INLINED)

    def _string(self, text: str) -> int:
        return self._strings.setdefault(self._token(text), len(self._strings))

    def _place(self, data: bytes) -> int:
        """Append a value; return where it lies, a multiple of 8."""
        self._values += bytes(-len(self._values) % 8)
        place = len(self._values)
        self._values += data
        return place

    def _reference_to(self, value: float | str | dict) -> int:
        """Return a reference to metadata; texts are tokens, but strings in dictionaries."""
        if isinstance(value, str):
            return self._token_reference(value)
        if isinstance(value, dict):
            return self._dictionary(value)
        return reference(DOUBLE, self._place(struct.pack("<d", value)))

    def _dictionary(self, value: dict[str, str | dict]) -> int:
        data = struct.pack("<Q", len(value))
        for key, one in value.items():
            inner = self._dictionary(one) if isinstance(one, dict) else reference(STRING, self._string(one), _INLINED)
            data += struct.pack("<IqQ", self._string(key), 8, inner)  # the reference lies 8 bytes behind that number
        return reference(DICTIONARY, self._place(data))

    def _field(self, name: str, value: int) -> int:
        """Return the number of a field, which stands behind those of the attributes with samples."""
        return self._fields.setdefault((self._token(name), value), 2 * len(self._sizes) + len(self._fields))

    def _set(self, fields: Iterable[tuple[str, int]]) -> int:
        """Return where a set of fields begins, given by names and references."""
        return self._set_of([self._field(*one) for one in fields])

    def _set_of(self, fields: Sequence[int]) -> int:
        key = tuple(fields)
        if key not in self._sets:
            self._sets[key] = self._next_set
            self._next_set += len(key) + 1
        return self._sets[key]

    def _properties_of(self, path: str) -> list[tuple[int, int]]:
        """Return tokens and sets of fields of the properties of a prim, which is made with those above it."""
        if path not in self._properties:
            above = path.rpartition("/")[0] or "/"
            self._properties_of(above)
            self._properties[path], self._children[path] = [], []
            self._children[above].append(path)
        return self._properties[path]

    # ---------------------------------------------------------------------------------------------------------------

    def _encode_prims(self) -> tuple[bytes, bytes]:
        """Return the tables of paths and of specs, which have the same order: prims, each before what it holds."""
        order, waiting = list[str](), ["/"]
        while waiting:
            order.append(path := waiting.pop())
            waiting += reversed(self._children[path])
        sizes = dict[str, int]()
        for path in reversed(order):
            sizes[path] = 1 + len(self._properties[path]) + sum(sizes[child] for child in self._children[path])
        last = {"/", *(children[-1] for children in self._children.values() if children)}
        names = {path: self._token(path.rpartition("/")[2]) for path in order}
        tokens, jumps, sets, kinds = list[int](), list[int](), list[int](), list[int]()
        for path in order:
            own, children = self._properties[path], self._children[path]
            held = [token for token, _ in own]
            tokens += [names[path], *(-token for token in held)]
            # to the next sibling; -1 where there is none but something below, 0 with nothing below, -2 without both
            jumps.append((-1 if path in last else sizes[path]) if own or children else (-2 if path in last else 0))
            jumps += [0] * len(own)
            if own and not children:
                jumps[-1] = -2
            sets += [self._prim_set(path, held, [names[child] for child in children]), *(one for _, one in own)]
            kinds += [_PRIM, *[_ATTRIBUTE] * len(own)]
        tokens[0], kinds[0] = 0, _PSEUDO_ROOT
        numbers, count = _integers(range(len(sets))), struct.pack("<Q", len(sets))
        paths = [count, count, numbers, _integers(tokens), _integers(jumps)]
        return b"".join(paths), b"".join([count, numbers, _integers(sets), _integers(kinds)])

    def _prim_set(self, path: str, properties: list[int], children: list[int]) -> int:
        """Return the set of fields of a prim, by tokens of what it holds."""
        fields = [*self._metadata] if path == "/" else [self._over]
        if path in self._editable:
            fields.append(self._field("instanceable", reference(BOOL, 0, _INLINED)))
        for name, held in (("properties", properties), ("primChildren", children)):
            if held:
                fields.append(self._field(name, self._token_vector(tuple(held))))
        return self._set_of(fields)

    def _token_vector(self, tokens: tuple[int, ...]) -> int:
        if tokens not in self._vectors:
            self._vectors[tokens] = reference(TOKEN_VECTOR, self._place(_counted(tokens)))
        return self._vectors[tokens]

    def _encode_fields(self, heads: int, first_frame: int) -> bytes:
        """Return the table of fields: default and samples of each attribute, and the others."""
        attributes = len(self._sizes)
        names, values = np.empty(2 * attributes, dtype=np.int32), np.empty(2 * attributes, dtype=np.uint64)
        names[::2], names[1::2] = self._token("default"), self._token("timeSamples")
        places = first_frame + np.cumsum(self._sizes) - self._sizes
        values[::2] = np.array(self._types, dtype=np.uint64) | places.astype(np.uint64)
        values[1::2] = reference(TIME_SAMPLES, heads) + HEAD * np.arange(attributes)
        others = np.array(list(self._fields), dtype=np.uint64).reshape(-1, 2)
        values = _compressed(np.concatenate([values, others[:, 1]]).tobytes())
        names = _integers(np.concatenate([names, others[:, 0].astype(np.int32)]))
        return struct.pack("<Q", 2 * attributes + len(others)) + names + struct.pack("<Q", len(values)) + values

    def _encode_sets(self) -> bytes:
        """Return the table of sets of fields: those of the attributes with samples, and the others."""
        attributes = len(self._sizes)
        sampled = np.full((attributes, _PER_SAMPLED), _NO_FIELD, dtype=np.uint32)
        sampled[:, 0], sampled[:, 1] = self._type_fields, 2 * np.arange(attributes)
        sampled[:, 2] = sampled[:, 1] + 1
        others = [number for one in self._sets for number in (*one, _NO_FIELD)]
        table = np.append(sampled, np.array(others, dtype=np.uint32))
        return struct.pack("<Q", len(table)) + _integers(table.view(np.int32))

    def _encode_tokens(self) -> bytes:
        text = "".join(f"{one}\0" for one in self._tokens).encode()
        data = _compressed(text)
        return struct.pack("<QQQ", len(self._tokens), len(text), len(data)) + data


def _counted(numbers: Iterable[int]) -> bytes:
    """Return how many numbers there are, and the numbers."""
    table = np.fromiter(numbers, dtype="<u4")
    return struct.pack("<Q", len(table)) + table.tobytes()


def _integers(values: Sequence[int] | np.ndarray) -> bytes:
    """Return the size of a table of integers and the table: differences, of which the most frequent takes two bits."""
    differences = np.diff(np.asarray(values, dtype=np.int32), prepend=np.int32(0))
    found, counts = np.unique(differences, return_counts=True)
    common = found[np.argmax(counts)]
    widths = np.where(np.abs(differences) < 1 << 7, 1, np.where(np.abs(differences) < 1 << 15, 2, 4))
    widths[differences == common] = 0
    codes = np.zeros(-(-len(widths) // 4) * 4, dtype=np.uint8)
    codes[: len(widths)] = np.minimum(widths, 3)
    packed = codes.reshape(-1, 4) << np.array((0, 2, 4, 6), dtype=np.uint8)
    others = differences.astype("<i4").view(np.uint8).reshape(-1, 4)[np.arange(4) < widths[:, None]]
    data = _compressed(b"".join([struct.pack("<i", common), packed.sum(axis=1, dtype=np.uint8), others]))
    return struct.pack("<Q", len(data)) + data


def _compressed(data: bytes) -> bytes:
    """Return data as one piece of one block of LZ4, all of it literal."""
    more, rest = divmod(len(data) - 15, 255)
    length = bytes((len(data) << 4,)) if more < 0 else b"\xf0" + b"\xff" * more + bytes((rest,))
    return b"\0" + length + data
