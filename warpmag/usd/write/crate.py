"""Encodes crate files (``.usdc``) with many attributes of the same kind; USD itself takes 20 µs for each attribute.

A crate file holds values, then its structure: tables that refer to each other by number. They are tokens, fields (a
name and a reference to a value), sets of fields, paths, and specs (a path and its set of fields). A reference has eight
bytes: the type of a value, and either the value itself or its place in the file. Integers in tables are stored as
differences. Tables are LZ4 blocks, here of literals only, which need no compression.

Format: https://github.com/PixarAnimationStudios/OpenUSD, ``pxr/usd/usd/crateFile.cpp`` and ``integerCoding.cpp``.
"""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import starmap

import numpy as np

BOOL, DOUBLE, STRING, TOKEN, QUATF, VEC3D, VEC3F, DICTIONARY = 1, 9, 10, 11, 17, 23, 24, 31
TOKEN_VECTOR, SPECIFIER, VARIABILITY, TIME_SAMPLES, DOUBLE_VECTOR = 41, 42, 44, 46, 48
"""Numbers of value types in references."""
MAGIC = b"PXR-USDC"
"""First bytes of a crate file."""
HEAD = 24
"""Size of the head of an attribute's time samples, see ``samples.py`` [bytes]."""
CONTENTS = 16
"""Place of the field that holds the place of the table of contents [bytes]."""
SECTION, SECTION_NAME = 32, 16
"""Size of an entry of the table of contents, and of the name at its beginning [bytes]."""
_BOOTSTRAP = 88
_VERSION = bytes((0, 8, 0))
_ARRAY, _INLINED = 1 << 63, 1 << 62
_OVER, _UNIFORM = 1, 1
_ATTRIBUTE, _PRIM, _PSEUDO_ROOT = 1, 6, 7
_NO_FIELD = 0xFFFFFFFF
_FIELDS_PER_SAMPLED = 4
"""Entries in the set of fields of an attribute with samples: type name, default, samples and the end mark."""


def reference(kind: int, payload: int, flags: int = 0) -> int:
    """Return a reference: ``payload`` is the place of the value [bytes], or with ``_INLINED`` the value itself."""
    return flags | kind << 48 | payload


@dataclass(frozen=True)
class LayerFile:
    """An encoded layer, with places in the file [bytes]."""

    values: bytes  # first part of the file; the place of the table of contents is not set yet
    structure: bytes  # last part of the file, valid directly behind ``values``
    contents: int  # place of the table of contents in ``structure``
    heads: int  # place of the first head of time samples; the heads are contiguous and still zero
    end_code: int  # place of ``endTimeCode``
    types: np.ndarray  # references of each sampled attribute without the place of a value, shape [attributes]


class OverLayer:
    """A layer of ``over`` prims with attributes, some of which get time samples later.

    Sampled attributes are numbered in the order in which they are added. Their defaults are the values of the first
    frame, which must follow directly behind the values of the layer.
    """

    def __init__(self, sizes: np.ndarray):
        """Create an empty layer; ``sizes`` holds the size of a value of each sampled attribute [bytes]."""
        self._sizes = sizes
        self._types, self._type_fields = list[int](), list[int]()
        self._tokens, self._strings = {";-)": 0}, dict[int, int]()  # properties are negative tokens, so none may be 0
        self._values, self._end_code = bytearray(_BOOTSTRAP), -1
        self._fields, self._sets = dict[tuple[int, int], int](), dict[tuple[int, ...], int]()
        self._next_set = _FIELDS_PER_SAMPLED * len(sizes)
        self._metadata, self._over = list[int](), self._field("specifier", reference(SPECIFIER, _OVER, _INLINED))
        self._properties: dict[str, list[tuple[int, int]]] = {"/": []}
        self._children: dict[str, list[str]] = {"/": []}
        self._editable, self._vectors = set[str](), dict[tuple[int, ...], int]()

    def set_metadata(self, name: str, value: float | str | dict) -> None:
        """Set metadata of the layer; texts become tokens, but strings in dictionaries."""
        if isinstance(value, str):
            value_reference = self._token_reference(value)
        elif isinstance(value, dict):
            value_reference = self._dictionary(value)
        else:
            value_reference = reference(DOUBLE, self._place(struct.pack("<d", value)))
        if name == "endTimeCode":
            self._end_code = len(self._values) - 8
        self._metadata.append(self._field(name, value_reference))

    def add_sampled(self, paths: Sequence[str], name: str, type_name: str, kind: int) -> None:
        """Add an attribute with time samples to prims; for an array such as ``quatf[]``, ``kind`` is its element."""
        type_field = self._field("typeName", self._token_reference(type_name))
        token = self._token(name)
        for number, path in enumerate(paths, len(self._types)):
            self._properties_of(path).append((token, _FIELDS_PER_SAMPLED * number))
        self._types += [reference(kind, 0, _ARRAY if type_name.endswith("[]") else 0)] * len(paths)
        self._type_fields += [type_field] * len(paths)

    def add_vector(self, path: str, name: str, value: np.ndarray) -> None:
        """Add a constant attribute of type ``double3`` to a prim; ``value`` has shape [3]."""
        place = self._place(np.asarray(value, dtype="<f8").tobytes())
        fields = (("typeName", self._token_reference("double3")), ("default", reference(VEC3D, place)))
        self._properties_of(path).append((self._token(name), self._set(starmap(self._field, fields))))

    def add_tokens(self, paths: Iterable[str], name: str, tokens: Sequence[str]) -> None:
        """Add a uniform attribute of type ``token[]`` to prims."""
        fields = (
            ("typeName", self._token_reference("token[]")),
            ("variability", reference(VARIABILITY, _UNIFORM, _INLINED)),
            ("default", reference(TOKEN, self._place(_counted(map(self._token, tokens))), _ARRAY)),
        )
        attribute = self._token(name), self._set(starmap(self._field, fields))
        for path in paths:
            self._properties_of(path).append(attribute)

    def make_editable(self, path: str) -> None:
        """Set ``instanceable = false`` on a prim."""
        self._properties_of(path)
        self._editable.add(path)

    def encode(self) -> LayerFile:
        """Return the layer as a file."""
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
        """Append a value; return its place, a multiple of 8."""
        self._values += bytes(-len(self._values) % 8)
        place = len(self._values)
        self._values += data
        return place

    def _dictionary(self, value: dict[str, str | dict]) -> int:
        data = struct.pack("<Q", len(value))
        for key, item in value.items():
            text = isinstance(item, str)
            inner = reference(STRING, self._string(item), _INLINED) if text else self._dictionary(item)
            data += struct.pack("<IqQ", self._string(key), 8, inner)  # the reference follows 8 bytes behind this offset
        return reference(DICTIONARY, self._place(data))

    def _field(self, name: str, value: int) -> int:
        """Return the number of a field; fields of sampled attributes come first."""
        return self._fields.setdefault((self._token(name), value), 2 * len(self._sizes) + len(self._fields))

    def _set(self, fields: Iterable[int]) -> int:
        """Return the index at which a set of fields begins."""
        key = tuple(fields)
        if key not in self._sets:
            self._sets[key] = self._next_set
            self._next_set += len(key) + 1
        return self._sets[key]

    def _properties_of(self, path: str) -> list[tuple[int, int]]:
        """Return tokens and sets of fields of a prim's properties; the prim and its parents are created."""
        if path not in self._properties:
            parent = path.rpartition("/")[0] or "/"
            self._properties_of(parent)
            self._properties[path], self._children[path] = [], []
            self._children[parent].append(path)
        return self._properties[path]

    # ---------------------------------------------------------------------------------------------------------------

    def _encode_prims(self) -> tuple[bytes, bytes]:
        """Return the tables of paths and specs in the same order: each prim, its properties, its children."""
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
            properties, children = self._properties[path], self._children[path]
            property_tokens = [token for token, _ in properties]
            tokens += [names[path], *(-token for token in property_tokens)]
            # offset to the next sibling; -1 for the last with a subtree, 0 without a subtree, -2 for the last without
            if properties or children:
                jumps.append(-1 if path in last else sizes[path])
            else:
                jumps.append(-2 if path in last else 0)
            jumps += [0] * len(properties)
            if properties and not children:
                jumps[-1] = -2
            sets.append(self._prim_set(path, property_tokens, [names[child] for child in children]))
            sets += [fields for _, fields in properties]
            kinds += [_PRIM, *[_ATTRIBUTE] * len(properties)]
        tokens[0], kinds[0] = 0, _PSEUDO_ROOT
        numbers, count = _integers(range(len(sets))), struct.pack("<Q", len(sets))
        paths = [count, count, numbers, _integers(tokens), _integers(jumps)]
        return b"".join(paths), b"".join([count, numbers, _integers(sets), _integers(kinds)])

    def _prim_set(self, path: str, properties: list[int], children: list[int]) -> int:
        """Return the set of fields of a prim with the tokens of its properties and children."""
        fields = [*self._metadata] if path == "/" else [self._over]
        if path in self._editable:
            fields.append(self._field("instanceable", reference(BOOL, 0, _INLINED)))
        for name, tokens in (("properties", properties), ("primChildren", children)):
            if tokens:
                fields.append(self._field(name, self._token_vector(tuple(tokens))))
        return self._set(fields)

    def _token_vector(self, tokens: tuple[int, ...]) -> int:
        if tokens not in self._vectors:
            self._vectors[tokens] = reference(TOKEN_VECTOR, self._place(_counted(tokens)))
        return self._vectors[tokens]

    def _encode_fields(self, heads: int, first_frame: int) -> bytes:
        """Return the table of fields: default and samples of each sampled attribute, then other fields."""
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
        """Return the table of sets of fields: sets of sampled attributes, then other sets."""
        attributes = len(self._sizes)
        sampled = np.full((attributes, _FIELDS_PER_SAMPLED), _NO_FIELD, dtype=np.uint32)
        sampled[:, 0], sampled[:, 1] = self._type_fields, 2 * np.arange(attributes)
        sampled[:, 2] = sampled[:, 1] + 1
        others = [number for fields in self._sets for number in (*fields, _NO_FIELD)]
        table = np.append(sampled, np.array(others, dtype=np.uint32))
        return struct.pack("<Q", len(table)) + _integers(table.view(np.int32))

    def _encode_tokens(self) -> bytes:
        text = "".join(f"{token}\0" for token in self._tokens).encode()
        data = _compressed(text)
        return struct.pack("<QQQ", len(self._tokens), len(text), len(data)) + data


def _counted(numbers: Iterable[int]) -> bytes:
    """Return numbers with their count in front."""
    table = np.fromiter(numbers, dtype="<u4")
    return struct.pack("<Q", len(table)) + table.tobytes()


def _integers(values: Sequence[int] | np.ndarray) -> bytes:
    """Return differences of integers with their size in front; the most frequent difference takes two bits."""
    differences = np.diff(np.asarray(values, dtype=np.int32), prepend=np.int32(0))
    values, counts = np.unique(differences, return_counts=True)
    common = values[np.argmax(counts)]
    widths = np.where(np.abs(differences) < 1 << 7, 1, np.where(np.abs(differences) < 1 << 15, 2, 4))
    widths[differences == common] = 0
    codes = np.zeros(-(-len(widths) // 4) * 4, dtype=np.uint8)
    codes[: len(widths)] = np.minimum(widths, 3)
    packed = codes.reshape(-1, 4) << np.array((0, 2, 4, 6), dtype=np.uint8)
    others = differences.astype("<i4").view(np.uint8).reshape(-1, 4)[np.arange(4) < widths[:, None]]
    data = _compressed(b"".join([struct.pack("<i", common), packed.sum(axis=1, dtype=np.uint8), others]))
    return struct.pack("<Q", len(data)) + data


def _compressed(data: bytes) -> bytes:
    """Return data as one LZ4 block of literals."""
    more, rest = divmod(len(data) - 15, 255)
    length = bytes((len(data) << 4,)) if more < 0 else b"\xf0" + b"\xff" * more + bytes((rest,))
    return b"\0" + length + data
