"""What an accepted stage says, read with plain USD, against what Newton's model and the written cache hold.

Nothing of warpmag's own reader is used: bodies, poses, sizes, masses, frictions, gravity and moments are read again.
"""

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import newton
import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade

WRITTEN = ("physics:velocity", "physics:angularVelocity", "warpmag:moment")
FAST = 1000.0  # degrees/s
DENSITY = 1000.0  # kg/m³: UsdPhysics where nobody gives one
DENSITIES = {"iron": 7870.0, "N42": 7500.0}
"""What the named materials of the sources weigh by any handbook [kg/m³], where nobody gives anything else."""


def differences(path: Path, output: Path, simulation) -> list[str]:
    """Return where a run says other things than its stage; without the simulation, where its cache does."""
    stage, result = Usd.Stage.Open(str(path)), Usd.Stage.Open(str(output))
    reading = Reading(stage)
    problems = [*not_finite(result), *_poses(reading, result), *_instances(reading, result), *_moments(reading, result)]
    if simulation is not None:
        problems += [*_masses(reading, simulation), *_shapes(reading, simulation), *_gravity(reading, simulation)]
        problems += _sources(reading, simulation)
    return problems


def _prims_of(stage) -> tuple[list, list]:
    """Prims that are no prototypes of instancers, and the instancers."""
    prims, instancers = [], []
    traversal = iter(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))
    for prim in traversal:
        prims.append(prim)
        if prim.IsA(UsdGeom.PointInstancer):
            instancers.append(UsdGeom.PointInstancer(prim))
            traversal.PruneChildren()
    return prims, instancers


class Reading:
    """A stage at its start, as plain USD reads it, in its own units."""

    def __init__(self, stage):
        self.stage, self.time = stage, Usd.TimeCode(stage.GetStartTimeCode())
        self.transforms = UsdGeom.XformCache(self.time)
        self.metres, self.kilograms = UsdGeom.GetStageMetersPerUnit(stage), UsdPhysics.GetStageKilogramsPerUnit(stage)
        self.prims, self.instancers = _prims_of(stage)
        self.bodies = self.enabled("physics:rigidBodyEnabled", "PhysicsRigidBodyAPI")
        self.colliders = self.enabled("physics:collisionEnabled", "PhysicsCollisionAPI")

    def get(self, prim, name, default=None):
        """The value of an attribute at the start."""
        attribute = prim.GetAttribute(name)
        value = attribute.Get(self.time) if attribute else None
        if value is None and attribute:  # blocked
            value = prim.GetPrimDefinition().GetAttributeFallbackValue(name)
        return default if value is None else value

    def enabled(self, switch, api) -> list:
        return [prim for prim in self.prims if api in prim.GetAppliedSchemas() and self.get(prim, switch, True)]

    def world(self, prim) -> np.ndarray:
        return np.array(self.transforms.GetLocalToWorldTransform(prim))

    def above(self, prim):
        """The body that a prim moves with."""
        while prim and prim not in self.bodies:
            prim = prim.GetParent()
        return prim or None

    def driven(self) -> list:
        """Colliders and coils of no body that time samples move, and that are in none of them.

        They become kinematic bodies.
        """
        coils = [prim for prim in self.prims if "WarpmagCoilAPI" in prim.GetAppliedSchemas()]
        moving = []
        for prim in [*self.colliders, *(coil for coil in coils if coil not in self.colliders)]:
            lineage = [prim, *(ancestor for ancestor in self.prims if prim.GetPath().HasPrefix(ancestor.GetPath()))]
            if self.above(prim) or not set(lineage).isdisjoint(moving):
                continue
            placed = [UsdGeom.Xformable(ancestor) for ancestor in lineage if ancestor.IsA(UsdGeom.Xformable)]
            times = {time for xformable in placed for time in xformable.GetTimeSamples()}
            poses = [np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(prim)) for time in times]
            if any((pose != poses[0]).any() for pose in poses):
                moving.append(prim)
        return moving

    def volume(self, prim) -> float | None:
        """Volume of a collider, None where its approximation decides."""
        matrix = self.world(prim)[:3, :3]
        kind, scales = prim.GetTypeName(), np.linalg.norm(matrix, axis=1)
        if kind in ("Capsule", "Cone", "Cylinder", "Sphere") and np.ptp(scales) > 1e-4 * scales.max():
            return None
        sizes = [self.get(prim, name, 0.0) for name in ("size", "radius", "height")]
        size, radius, height = (np.float64(value if isinstance(value, float) else 0.0) for value in sizes)
        with np.errstate(over="ignore", invalid="ignore"):  # sizes that are not this kind's
            local = {
                "Sphere": 4.0 / 3.0 * math.pi * radius**3,
                "Cube": size**3,
                "Cylinder": math.pi * radius**2 * height,
                "Cone": math.pi * radius**2 * height / 3.0,
                "Capsule": math.pi * radius**2 * (height + 4.0 / 3.0 * radius),
            }.get(kind)
        if kind == "Mesh" and self.get(prim, "physics:approximation", "none") in ("none", "convexHull"):
            local = self.mesh_volume(prim)
        return None if local is None else abs(local * np.linalg.det(matrix))

    def mesh_volume(self, prim) -> float | None:
        """Volume of a mesh, also of one whose hull collides; None for the hull of an open mesh (a warning)."""
        if self.get(prim, "physics:approximation", "none") == "convexHull" and not self.is_closed(prim):
            return None
        points = np.array(self.get(prim, "points"), dtype=float)
        total, place = 0.0, 0
        indices = np.array(self.get(prim, "faceVertexIndices"))
        for count in self.get(prim, "faceVertexCounts"):
            face = points[indices[place : place + count]]
            place += count
            for k in range(1, count - 1):
                total += face[0] @ np.cross(face[k], face[k + 1]) / 6.0
        return total

    def is_closed(self, prim) -> bool:
        """Return True if each edge of a mesh has its counterpart."""
        indices, place, edges = self.get(prim, "faceVertexIndices"), 0, Counter()
        for count in self.get(prim, "faceVertexCounts"):
            face = indices[place : place + count]
            place += count
            for first, second in zip(face, [*face[1:], *face[:1]], strict=True):
                edges[first, second] += 1
                edges[second, first] -= 1
        return not any(edges.values())

    def material(self, prim):
        """The material that is bound to a collider where the schema of bindings is applied, too."""
        bound, relationship = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
        valid = relationship and "MaterialBindingAPI" in relationship.GetPrim().GetAppliedSchemas()
        return bound.GetPrim() if valid else None

    def is_ambiguous(self, prim) -> bool:
        """Whether a material is bound without the schema: USD's parser passes over it, its masses do not."""
        bound, relationship = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
        return bool(bound and relationship) and self.material(prim) is None

    def density(self, prim) -> float:
        """Density of a collider: its own, that of what it is part of, its material's, water's."""
        holder = prim
        while holder and not holder.IsPseudoRoot():
            if (
                "PhysicsMassAPI" in holder.GetAppliedSchemas()
                and (own := self.get(holder, "physics:density", 0.0)) > 0.0
            ):
                return own
            if holder in self.bodies:
                break
            holder = holder.GetParent()
        material = self.material(prim)
        given = material and "PhysicsMaterialAPI" in material.GetAppliedSchemas()
        own = given and self.get(material, "physics:density", 0.0)
        return own or self.usual_density(prim) * self.metres**3 / self.kilograms

    def usual_density(self, prim) -> float:
        """Density of a collider of which nobody says anything [kg/m³]: that of the magnet's material, or water's."""
        magnets = [
            magnet for magnet in (prim, self.above(prim)) if magnet and "WarpmagMagnetAPI" in magnet.GetAppliedSchemas()
        ]
        named = [name for magnet in magnets if (name := self.get(magnet, "warpmag:material"))]
        return DENSITIES[named[0]] if named else DENSITY

    def own_mass(self, prim) -> float:
        """Mass that a prim gives itself, 0 where it does not."""
        return self.get(prim, "physics:mass", 0.0) if "PhysicsMassAPI" in prim.GetAppliedSchemas() else 0.0

    def mass(self, body) -> float | None:
        """Mass of a body, None where shapes decide that are not known here."""
        if own := self.own_mass(body):
            return own
        total = 0.0
        for collider in self.colliders:
            if self.above(collider) == body:
                own = self.own_mass(collider)
                volume = self.volume(collider)
                if (volume is None or self.is_ambiguous(collider)) and not own:
                    return None
                total += own or volume * self.density(collider)
        masses = list(self.instanced_masses(body))
        return None if None in masses else total + sum(masses)

    def instanced_masses(self, body) -> Iterator[float | None]:
        """Masses of colliders of instances that move with a body, None where they are not known here."""
        for instancer in self.instancers:
            if self.above(instancer.GetPrim()) != body:
                continue
            targets, kind = instancer.GetPrototypesRel().GetForwardedTargets(), UsdGeom.PointInstancer
            placed = instancer.ComputeInstanceTransformsAtTime(
                self.time, self.time, kind.IncludeProtoXform, kind.IgnoreMask
            )
            indices = instancer.GetProtoIndicesAttr().Get(self.time) or ()
            inactive = instancer.GetPrim().GetMetadata("inactiveIds")
            inactive = set(inactive.GetAppliedItems()) if inactive else set()
            ids = instancer.GetIdsAttr().Get(self.time) or range(len(indices))
            for number, index, matrix in zip(ids, indices, placed, strict=True):
                if number not in inactive:
                    size = np.linalg.norm(np.array(matrix)[:3, :3] @ self.world(instancer.GetPrim())[:3, :3], axis=1)
                    yield from self._masses_within(self.stage.GetPrimAtPath(targets[index]), body, size)

    def _masses_within(self, root, body, size) -> Iterator[float | None]:
        """Masses of the colliders below the root of a prototype, of scale ``size``, which have no body of their own."""
        prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate)))
        for prim in prims:
            schemas = prim.GetAppliedSchemas()
            if "PhysicsRigidBodyAPI" in schemas and self.get(prim, "physics:rigidBodyEnabled", True):
                prims.PruneChildren()
            elif prim.IsA(UsdGeom.PointInstancer):
                prims.PruneChildren()
                yield None
            elif "PhysicsCollisionAPI" in schemas and self.get(prim, "physics:collisionEnabled", True):
                scale = np.abs(np.linalg.det(self.world(root)[:3, :3]))
                volume, known = (
                    self.volume(prim),
                    not UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0],
                )
                known = known and "PhysicsMassAPI" not in body.GetAppliedSchemas() and np.ptp(size) <= 1e-4 * size.max()
                own = self.own_mass(prim)
                yield own or (
                    volume * size.prod() / scale * self.density(prim) if known and volume is not None else None
                )


def not_finite(stage) -> list[str]:
    """Return the attributes written by a run that hold numbers that are none."""
    problems = []
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        names = [name for name in prim.GetAuthoredPropertyNames() if name.endswith(":warpmag")]
        for name in (*names, *(WRITTEN if names or prim.HasAttribute("warpmag:moment") else ())):
            attribute = prim.GetAttribute(name)
            for time in attribute.GetTimeSamples() if attribute else ():
                value = attribute.Get(time)
                numbers = (value.GetReal(), *value.GetImaginary()) if hasattr(value, "GetReal") else value
                if not np.isfinite(np.array(numbers, dtype=float)).all():
                    problems.append(f"not finite: {attribute.GetPath()} at {time}")
                    break
    return problems[:3]


def _poses(reading, result):
    """Compare the poses and velocities that the cache starts with; velocities are in the frame of the body."""
    start = Usd.TimeCode(result.GetStartTimeCode())
    cache = UsdGeom.XformCache(start)
    for prim in reading.bodies:
        given = reading.world(prim)
        written = np.array(cache.GetLocalToWorldTransform(result.GetPrimAtPath(prim.GetPath())))
        size = np.abs(given[3, :3]).max() + np.linalg.norm(given[:3, :3], axis=1).max()
        if not np.abs(given - written).max() <= 1e-4 * size:
            yield f"pose of {prim.GetPath()}: {np.abs(given - written).max():g} off"
        for name in ("physics:velocity", "physics:angularVelocity"):
            wanted = np.array(reading.get(prim, name, (0.0, 0.0, 0.0)), dtype=float)
            value = np.array(result.GetPrimAtPath(prim.GetPath()).GetAttribute(name).Get(start), dtype=float)
            if not np.allclose(wanted, value, rtol=1e-4, atol=1e-5 * np.abs(wanted).max() + 1e-12):
                yield f"{name} of {prim.GetPath()}: {value} for {wanted}"


def _instances(reading, result):
    """Compare the places at which bodies of instances start with where USD puts them."""
    start, kinds = Usd.TimeCode(result.GetStartTimeCode()), UsdGeom.PointInstancer
    cache = UsdGeom.XformCache(start)
    for instancer in reading.instancers:
        kind = instancer.GetProtoIndicesAttr().Get(start) or ()
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        if result.GetPrimAtPath(instancer.GetPath()).IsA(UsdGeom.PointInstancer):
            continue  # only seen
        placed = instancer.ComputeInstanceTransformsAtTime(start, start, kinds.IncludeProtoXform, kinds.IgnoreMask)
        above = reading.transforms.GetLocalToWorldTransform(instancer.GetPrim())
        for row, matrix in enumerate(placed):
            root = reading.stage.GetPrimAtPath(targets[kind[row]])
            prim = result.GetPrimAtPath(f"{instancer.GetPath()}/instance{row}/{root.GetName()}")
            if not prim or root.IsA(UsdGeom.PointInstancer):  # inactive
                continue
            given, pose = np.array(matrix * above), np.array(cache.GetLocalToWorldTransform(prim))
            size = np.abs(given[3, :3]).max() + np.linalg.norm(given[:3, :3], axis=1).max()
            if not np.abs(given - pose).max() <= 2e-3 * size:  # half-precision quaternions
                yield f"pose of {prim.GetPath()}: {np.abs(given - pose).max():g} off"


def _masses(reading, simulation):
    model, numbers = simulation.model, simulation._scene.bodies
    masses, inverses = model.body_mass.numpy(), model.body_inv_mass.numpy()
    bodies = {str(prim.GetPath()) for prim in (*reading.bodies, *reading.driven())}
    if set(numbers) != bodies and not (reading.instancers and set(numbers) > bodies):
        yield f"bodies: {len(numbers)} in the model, {len(bodies)} on the stage"
        return
    for prim in reading.bodies:
        wanted, mass = reading.mass(prim), masses[numbers[str(prim.GetPath())]]
        wanted = None if wanted is None else reading.kilograms * wanted
        # Newton may find none for the hull of an open mesh, which counts for nothing where it is kinematic
        counts = mass != 0.0 or not reading.get(prim, "physics:kinematicEnabled", False)
        if counts and wanted is not None and not math.isclose(wanted, mass, rel_tol=1e-3):
            yield f"mass of {prim.GetPath()}: {mass:g} for {wanted:g}"
        if not (math.isfinite(mass) and np.isfinite(inverses).all()):
            yield f"mass of {prim.GetPath()} is {mass}"


def _shapes(reading, simulation):
    """Compare sizes, friction and restitution of colliders."""
    model = simulation.model
    scales, mu = model.shape_scale.numpy(), model.shape_material_mu.numpy()
    restitution = model.shape_material_restitution.numpy()
    sites = model.shape_flags.numpy() & newton.ShapeFlags.SITE  # a coil has the label of the collider that carries it
    numbers = {label: index for index, label in enumerate(model.shape_label) if not sites[index]}
    for prim in reading.colliders:
        index = numbers.get(str(prim.GetPath()))
        if index is None:
            if prim.IsA(UsdGeom.Gprim):
                yield f"collider {prim.GetPath()} is not in the model"
            continue
        if prim.IsA(UsdGeom.Sphere):
            wanted = reading.metres * reading.get(prim, "radius") * np.linalg.norm(reading.world(prim)[0, :3])
            if not math.isclose(wanted, scales[index][0], rel_tol=1e-4):
                yield f"radius of {prim.GetPath()}: {scales[index][0]:g} for {wanted:g}"
        material = reading.material(prim)
        if material and "PhysicsMaterialAPI" in material.GetAppliedSchemas():
            for name, value in (("physics:dynamicFriction", mu[index]), ("physics:restitution", restitution[index])):
                wanted = reading.get(material, name)
                given = material.GetAttribute(name).HasAuthoredValue()
                if given and not math.isclose(wanted, value, rel_tol=1e-5, abs_tol=1e-9):
                    yield f"{name} of {prim.GetPath()}: {value:g} for {wanted:g}"


def _gravity(reading, simulation):
    scenes = [prim for prim in reading.prims if prim.IsA(UsdPhysics.Scene)]
    if not scenes:
        return
    up = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0)}.get(UsdGeom.GetStageUpAxis(reading.stage), (0.0, 0.0, 1.0))
    strength = reading.get(scenes[0], "physics:gravityMagnitude", -math.inf)
    direction = np.array(reading.get(scenes[0], "physics:gravityDirection", (0.0, 0.0, 0.0)), dtype=float)
    direction = direction / np.linalg.norm(direction) if direction.any() else -np.array(up)
    wanted = direction * (9.81 if strength < 0.0 else reading.metres * strength)
    gravity = simulation.model.gravity.numpy()[0]
    if not np.allclose(wanted, gravity, rtol=1e-3, atol=1e-6):
        yield f"gravity {gravity} for {wanted}"


def _sources(reading, simulation):
    """Compare where coils and field maps start, and how strong they are."""
    model = simulation.model
    sites = {label: index for index, label in enumerate(model.shape_label)}
    bodies, frames, strengths = (
        array.numpy() for array in (model.shape_body, model.shape_transform, model.warpmag.strength)
    )
    poses = [np.eye(4), *map(_matrix, model.body_q.numpy())]
    for prim in reading.prims:
        kind = {"WarpmagCoilAPI", "WarpmagFieldMapAPI"}.intersection(prim.GetAppliedSchemas())
        if not kind:
            continue
        index = sites.get(str(prim.GetPath()))
        if index is None:
            yield f"source {prim.GetPath()} is not in the model"
            continue
        wanted, center = (
            reading.metres * reading.world(prim)[3, :3],
            (_matrix(frames[index]) @ poses[bodies[index] + 1])[3, :3],
        )
        if not np.allclose(wanted, center, rtol=1e-4, atol=1e-4 * np.abs(wanted).max() + 1e-9):
            yield f"place of {prim.GetPath()}: {center} for {wanted}"
        name, usual = {
            "WarpmagCoilAPI": ("warpmag:coil:ampereTurns", 0.0),
            "WarpmagFieldMapAPI": ("warpmag:fieldMap:factor", 1.0),
        }[kind.pop()]
        driven = reading.get(prim, "warpmag:coil:resistance", 0.0)  # its current follows from a voltage
        if driven or prim.GetAttribute(name).GetNumTimeSamples() > 1:  # switched meanwhile
            continue
        if not math.isclose(reading.get(prim, name, usual), strengths[index], rel_tol=1e-5, abs_tol=1e-30):
            yield f"{name} of {prim.GetPath()}: {strengths[index]:g} for {reading.get(prim, name, usual):g}"


def _matrix(transform) -> np.ndarray:
    """The matrix of a transform (x, y, z, quaternion), for rows, as USD has it."""
    turn = Gf.Matrix3d(Gf.Rotation(Gf.Quatd(float(transform[6]), Gf.Vec3d(*map(float, transform[3:6])))))
    return np.array(Gf.Matrix4d(turn, Gf.Vec3d(*map(float, transform[:3]))))


def _moments(reading, result):
    """Compare the moments of permanent magnets at the end with how they stand then, and who is a magnet at all."""
    end = Usd.TimeCode(_last_sample(result))
    start = result.GetStartTimeCode()
    times = Usd.TimeCode(start), Usd.TimeCode(start + 0.618 * (end.GetValue() - start)), end  # whole turns return
    caches = [UsdGeom.XformCache(time) for time in times]
    if result.GetEndTimeCode() == result.GetStartTimeCode():  # frames shorter than a step: no moments yet
        return
    for prim in reading.prims:
        if "WarpmagMagnetAPI" not in prim.GetAppliedSchemas():
            continue
        written = result.GetPrimAtPath(prim.GetPath()).GetAttribute("warpmag:moment").Get(end)
        if written is None:
            yield f"no moment of {prim.GetPath()}"
            continue
        written = np.array(written, dtype=float)  # squares of floats overflow
        if reading.get(prim, "warpmag:kind", "inducible") != "permanent" or reading.get(prim, "warpmag:material"):
            continue
        if prim.GetAttribute("warpmag:magnetization").GetNumTimeSamples() > 1:  # switched meanwhile
            continue
        if reading.get(prim, "warpmag:recoilPermeability", 1.0) > 1.0:  # yields to the field that it is in
            continue
        if not (whole := prim in reading.bodies) and _shares(reading, prim):
            continue
        members = [shape for shape in reading.colliders if shape == prim or (whole and reading.above(shape) == prim)]
        volumes = [reading.volume(shape) for shape in members]
        if len(volumes) != 1 or None in volumes:  # several may overlap
            continue
        before, between, after = (_turn(cache, result.GetPrimAtPath(prim.GetPath())) for cache in caches)
        given = np.array(reading.get(prim, "warpmag:magnetization", (0.0, 0.0, 0.0)), dtype=float)
        given *= volumes[0] * reading.metres**3
        size = np.linalg.norm(given)
        spin = reading.above(prim) and result.GetPrimAtPath(reading.above(prim).GetPath()).GetAttribute(WRITTEN[1]).Get(
            end
        )
        slow = not spin or spin.GetLength() < FAST
        # a moment is that of the last substep
        at_rest = slow and max(np.abs(after - before).max(), np.abs(after - between).max()) < 0.1
        at_rest &= not _is_beyond_floats(prim, end)
        least = float(np.finfo(np.float32).tiny)  # smaller numbers keep few digits
        apart = at_rest and np.linalg.norm(given @ after - written) > 0.2 * size + least
        if apart or not math.isclose(size, np.linalg.norm(written), rel_tol=1e-3, abs_tol=least):
            yield f"moment of {prim.GetPath()}: {written} for {given @ after}"


def _last_sample(result) -> float:
    """The time code of the last step, which may be a little later than the last whole frame."""
    attributes = (prim.GetAttribute("warpmag:moment") for prim in result.Traverse())
    return max(
        [
            result.GetEndTimeCode(),
            *(time for attribute in attributes if attribute for time in attribute.GetTimeSamples()[-1:]),
        ]
    )


def _shares(reading, prim) -> bool:
    """Whether another collider of the same body may have some of the volume of a collider that is a magnet."""
    box = UsdGeom.BBoxCache(reading.time, [UsdGeom.Tokens.default_, UsdGeom.Tokens.render, UsdGeom.Tokens.proxy])
    own, body = box.ComputeWorldBound(prim).ComputeAlignedRange(), reading.above(prim)
    others = [other for other in reading.colliders if body and other != prim and reading.above(other) == body]
    ranges = [box.ComputeWorldBound(other).ComputeAlignedRange() for other in others]
    return any(not Gf.Range3d.GetIntersection(own, span).IsEmpty() for span in ranges)


def _is_beyond_floats(prim, time) -> bool:
    """True if a prim or one above is turned by angles whose neighbors in single precision are over 1 degree apart.

    Between two keys the turn of the last substep and that of the frame then have nothing in common.
    """
    while prim and not prim.IsPseudoRoot():
        for operation in UsdGeom.Xformable(prim).GetOrderedXformOps() if prim.IsA(UsdGeom.Xformable) else ():
            if "rotate" in operation.GetName() and np.abs(np.array(operation.Get(time), float)).max() > 1e7:
                return True
        prim = prim.GetParent()
    return False


def _turn(cache, prim) -> np.ndarray:
    """The axes of a prim in the world, as rows."""
    matrix = np.array(cache.GetLocalToWorldTransform(prim))[:3, :3]
    return matrix / np.linalg.norm(matrix, axis=1)[:, None]
