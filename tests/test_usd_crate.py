"""Crate files written by hand: USD reads from them what it would have written itself."""

import struct

import numpy as np
import pytest
from pxr import Gf, Sdf, Vt

from warpmag.usd.write import crate
from warpmag.usd.write.samples import SampleFile

SIZES = {"moment": 12, "turn": 16, "place": 24}
TYPES = {
    "moment": (Sdf.ValueTypeNames.Vector3f, crate.VEC3F, Vt.Vec3fArray, np.float32),
    "turn": (Sdf.ValueTypeNames.Quatf, crate.QUATF, Vt.QuatfArray, np.float32),
    "place": (Sdf.ValueTypeNames.Double3, crate.VEC3D, Vt.Vec3dArray, np.float64),
}
METADATA = {"metersPerUnit": 0.1, "upAxis": "Z", "startTimeCode": -3.0, "endTimeCode": 1.0}
ABOUT = {"scene": 'ä "b"', "empty": "", "inner": {"one": 'ä "b"'}}


def paths_of(rng, count):
    """Prims in each other, some with what is between them missing, and many side by side."""
    paths = ["/World", "/Other/Deep/er/Prim_球"]
    while len(paths) < count:
        above = "/World" if rng.random() < 0.7 else paths[rng.integers(len(paths))]
        paths.append(f"{above}/P{len(paths)}" if rng.random() < 0.8 else f"{above}/Q/P{len(paths)}")
    return paths


@pytest.mark.parametrize("count", [2, 400])
def test_usd_reads_what_it_would_write(tmp_path, count):
    rng, usd = np.random.default_rng(count), Sdf.Layer.CreateAnonymous()
    paths = paths_of(rng, count)
    chosen = {name: [path for path in paths if rng.random() < 0.8] for name in SIZES}
    sizes = np.repeat(list(SIZES.values()), [len(chosen[name]) for name in SIZES])
    hand, data = crate.OverLayer(sizes), b""
    for name, value in METADATA.items():
        hand.set_metadata(name, value)
        usd.pseudoRoot.SetInfo(name, value)
    hand.set_metadata("customLayerData", {"warpmag": ABOUT})
    usd.customLayerData = {"warpmag": ABOUT}
    for name, (type_name, kind, array, dtype) in TYPES.items():
        values = rng.normal(size=(len(chosen[name]), SIZES[name] // np.dtype(dtype).itemsize)).astype(dtype)
        hand.add_sampled(chosen[name], f"warpmag:{name}", str(type_name), kind)
        data += values.tobytes()
        for path, value in zip(chosen[name], array.FromNumpy(values), strict=True):
            author(usd, f"{path}.warpmag:{name}", type_name, value)
    for path in paths[::3]:
        hand.add_vector(path, "size", np.array((1.0, 0.1, 3e300)))
        author(usd, f"{path}.size", Sdf.ValueTypeNames.Double3, Gf.Vec3d(1.0, 0.1, 3e300))
    hand.add_tokens(paths[1::2], "order", ("!b!", "a"))
    for path in paths[1::2]:
        author(usd, f"{path}.order", Sdf.ValueTypeNames.TokenArray, Vt.TokenArray(("!b!", "a")), uniform=True)
    for path in ("/World/Instance", paths[-1]):
        hand.make_editable(path)
        Sdf.CreatePrimInLayer(usd, path).instanceable = False
    file = SampleFile.begin(tmp_path / "hand.usdc", hand.encode(), sizes, 3)
    file.append(1.0, data, np.zeros(0, dtype=int))
    file.close()
    result = Sdf.Layer.FindOrOpen(str(tmp_path / "hand.usdc"))
    assert specs(result) == specs(usd)


@pytest.mark.parametrize("count", [1, 5, 64, 70])
def test_a_closed_file_has_as_many_references_as_times(tmp_path, count):
    """USD goes by the times alone, readers of other makes compare them; 70 frames need a longer file than there is."""
    hand, path = crate.OverLayer(np.full(3, 12)), tmp_path / "hand.usdc"
    hand.set_metadata("endTimeCode", 0.0)
    hand.add_sampled(["/A", "/B", "/C"], "warpmag:moment", "vector3f", crate.VEC3F)
    layer = hand.encode()
    file = SampleFile.begin(path, layer, np.full(3, 12), None)
    for number in range(count):
        values = np.full((3, 3), number, dtype=np.float32)
        file.append(float(number), values.tobytes(), np.array([0, 2] if number == 1 else [], dtype=int))
    file.close()
    data, result = path.read_bytes(), []
    for head in range(layer.heads, layer.heads + 3 * crate.HEAD, crate.HEAD):
        _, times, jump = struct.unpack_from("<qQq", data, head)
        result += [struct.unpack_from("<2Q", data, place)[0] for place in (times & (1 << 48) - 1, head + 16 + jump)]
    assert result == [count if sampled and count > 1 else 0 for sampled in (True, False, True) for _ in range(2)]


def author(layer, path, type_name, value, uniform=False):
    variability = Sdf.VariabilityUniform if uniform else Sdf.VariabilityVarying
    Sdf.JustCreatePrimAttributeInLayer(layer, Sdf.Path(path), type_name, variability, False)
    layer.GetAttributeAtPath(path).default = value


def specs(layer):
    """All fields of all specs by path; the names of what a spec holds without their order, samples unless empty."""
    results = {}

    def visit(path):
        spec = layer.GetObjectAtPath(path)
        info = {key: spec.GetInfo(key) for key in spec.ListInfoKeys()}
        if "timeSamples" in info and not layer.ListTimeSamplesForPath(path):
            del info["timeSamples"]
        results[str(path)] = info

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return results
