"""Packs a mesh with a physically based material as binary glTF 2.0, for web pages."""

import json
import struct
from collections.abc import Sequence

import numpy as np

_FLOAT, _INDEX = 5126, 5125  # float32, uint32
_VERTICES, _INDICES = 34962, 34963


def glb(points, normals, triangles, *, color: Sequence[float], metallic: float, roughness: float) -> bytes:
    """Return a mesh with a material as a binary glTF file.

    Points and their unit normals have the shape [n, 3], triangles [k, 3], with corners counterclockwise seen from
    outside. The color is linear RGB; metalness and roughness are 0 to 1.
    """
    points, normals = np.asarray(points, "<f4"), np.asarray(normals, "<f4")
    arrays = [points, normals, np.asarray(triangles, "<u4").reshape(-1)]
    starts = np.cumsum([0, *(array.nbytes for array in arrays)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target}
        for start, array, target in zip(starts, arrays, (_VERTICES, _VERTICES, _INDICES), strict=False)
    ]
    bounds = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    surface = {"baseColorFactor": [*color, 1.0], "metallicFactor": metallic, "roughnessFactor": roughness}
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 2, "material": 0}
    head = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": surface, "doubleSided": True}],
        "accessors": [
            {"bufferView": 0, "componentType": _FLOAT, "count": len(points), "type": "VEC3", **bounds},
            {"bufferView": 1, "componentType": _FLOAT, "count": len(points), "type": "VEC3"},
            {"bufferView": 2, "componentType": _INDEX, "count": arrays[2].size, "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
    }
    text = json.dumps(head, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(array.tobytes() for array in arrays)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks
