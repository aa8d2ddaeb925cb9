"""Three balls for tests of recorded runs: their scene, random frames, and the samples of a result."""

import itertools

import numpy as np
from pxr import Sdf, Usd

from warpmag.usd import open_stage

PATHS = [f"/World/Ball_{k}" for k in range(3)]
NAMES = ("xformOp:translate:warpmag", "xformOp:orient:warpmag", "physics:velocity", "physics:angularVelocity")
BALL = 'def Sphere "Ball_{}" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "WarpmagMagnetAPI"])\n{{\n}}\n'
SCENE = f"""#usda 1.0
(
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    timeCodesPerSecond = 128
)
def Xform "World"
{{
{"".join(BALL.format(k) for k in range(3))}
}}
"""


def open_scene(folder):
    """Save the scene as ``scene.usda`` in a folder, and open it."""
    path = folder / "scene.usda"
    path.write_text(SCENE)
    return open_stage(path)


def make_frames(count, seed=1):
    """Random poses, velocities and moments; rotations are small, so that no quaternion changes its sign."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(count, 3, 7)).astype(np.float32)
    q[..., 3:] = (0.0, 0.0, 0.0, 1.0) + 0.1 * q[..., 3:]
    q[..., 3:] /= np.linalg.norm(q[..., 3:], axis=-1, keepdims=True)
    return q, rng.normal(size=(count, 3, 6)).astype(np.float32), rng.normal(size=(count, 3, 3)).astype(np.float32)


def add(writer, frames, numbers, state=None):
    for k in numbers:
        writer.add_frame(k / 128, *(values[k] for values in frames))
        if writer.save_due:
            writer.save(state() if state else None)


def read(output):
    """Time samples of the attributes of a run's cache, by the path of the attribute."""
    layer = Sdf.Layer.OpenAsAnonymous(str(output.with_name(f"{output.stem}.cache.usdc")))
    samples = {}
    for path, name in itertools.product(PATHS, (*NAMES, "warpmag:moment")):
        at = f"{path}.{name}"
        samples[at] = {time: layer.QueryTimeSample(at, time) for time in layer.ListTimeSamplesForPath(at)}
    return samples


def assert_has(output, frames, count):
    """The stage opens with the first ``count`` frames; positions and moments are bitwise those that were added."""
    stage = Usd.Stage.Open(str(output))
    assert not stage.GetCompositionErrors()
    for index, path in enumerate(PATHS):
        samples = read(output)
        for name, values in ((NAMES[0], frames[0][..., :3]), ("warpmag:moment", frames[2])):
            of_time = samples[f"{path}.{name}"]
            assert list(of_time) == [float(k) for k in range(count)] or (count == 1 and not of_time)
            for time, value in of_time.items():
                assert np.array_equal(value, values[round(time), index])
