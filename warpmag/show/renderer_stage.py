"""A stage for renderers from a scene and its motion: instanced meshes, materials, lights, a camera, no physics.

Bodies become instances of two PointInstancers, one of balls and one of other bodies: importers drop the materials of
spheres and cubes, or make an object of each. Other drawn prims become meshes in place. The rate of time codes per
second is one at which players play. Time samples are at the times of the recording.
"""

import os
import tempfile
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils, Vt

from warpmag.errors import InputError
from warpmag.show.instances import InstanceArrays, author_curves, author_instances, rotations_from_z
from warpmag.show.materials import author_materialx, author_surface, bound_material, color_scale
from warpmag.show.meshes import ARROW, BALL, Shape, author_mesh, shape_of
from warpmag.show.web_page import page_of
from warpmag.usd.paths import usable_path
from warpmag.usd.read.ball_instancers import BallInstancer
from warpmag.usd.read.instancers import complete_instances, expand_instancers
from warpmag.usd.read.opening import copied_metadata, open_animated
from warpmag.usd.read.prims import is_body
from warpmag.usd.read.recording import read_recording
from warpmag.usd.read.transforms import rigid_part
from warpmag.usd.write.output import Output

_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz", ".html")
_SIMULATION_PREFIXES = ("physics:", "newton:", "warpmag:", "collection:")
"""Prefixes of attributes that describe a simulation."""
_SCHEMAS = ("Physics", "Newton", "Warpmag", "CollectionAPI")
_SIZES = ("radius", "radiusTop", "radiusBottom", "size", "height", "width", "length", "axis", "extent", "doubleSided")
_PURPOSES = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
_DIGITS = 6
"""Digits to which the points of shapes must agree to share a mesh."""
_SHADES = 24
"""Number of colors of a scale."""


@dataclass
class DrawnShape:
    """A shape of a body, or a static one."""

    path: str  # of the shape's prim
    row: int  # of the body in the recording, -1 for a static shape
    frame: np.ndarray  # of the prim in the frame of the body, or in the world, shape [4, 4], for rows of points
    drawn: bool  # True if the shape is visible
    radius: float  # of a ball, 0 for other shapes
    points: np.ndarray  # in the frame of the body, or in the world, shape [k, 3]; empty for a ball
    faces: list[np.ndarray]  # corners of each face
    appearance: tuple = ()  # path of the bound material or "", and display color or ()

    @property
    def center(self) -> np.ndarray:
        """Center of the bounding box, shape [3]."""
        return self.frame[3, :3] if self.radius else 0.5 * (self.points.min(axis=0) + self.points.max(axis=0))

    @property
    def size(self) -> float:
        """Largest side of the bounding box."""
        return 2.0 * self.radius if self.radius else float(np.ptp(self.points, axis=0).max())


class RendererStage:
    """Builds the stage from its ``recording`` and the ``shapes`` of bodies and magnets; :meth:`save` writes it.

    Methods raise :class:`InputError` if the file is not a stage, a magnet has no shape, or a file cannot be written.
    """

    def __init__(self, path: str | os.PathLike, *, rate: float):
        """Read a scene, or the recording of a run, for ``rate`` time codes and frames per second."""
        source, instancers = open_animated(path)
        self._files = {Path(layer.realPath).resolve() for layer in source.GetUsedLayers() if layer.realPath}
        self.recording = read_recording(source, instancers)
        self._codes = self.recording.codes * (rate / source.GetTimeCodesPerSecond())
        self._stage = stage = Usd.Stage.Open(_scene_of(source, instancers, rate))
        stage.SetStartTimeCode(float(np.floor(self._codes[0] + 1e-6)))
        # the last frame is at the step nearest to it, which may be slightly later
        stage.SetEndTimeCode(float(np.ceil(self._codes[-1] - 0.05)))
        self._scene = Sdf.Layer.CreateAnonymous(".usda")
        self._scene.TransferContent(stage.GetRootLayer())
        self.shapes = self._find_shapes()
        for instancer in instancers:
            self.shapes = instancer.with_copies(self.shapes, self.recording.bodies)
        instanced = self._instanced()
        self._moving = [shape for shape in self.shapes if shape.drawn and shape.row >= 0 and instanced[shape.row]]
        self._root = self._make_root()

    def _make_root(self) -> Sdf.Path:
        """Remove prims that are drawn as instances, or not at all; return the path of a prim for new ones."""
        stage, layer = self._stage, self._stage.GetRootLayer()
        moving = {shape.path for shape in self._moving}
        static = [shape for shape in self.shapes if shape.drawn and shape.path not in moving]
        kept = {shape.path for shape in static}
        with Sdf.ChangeBlock():
            _strip(layer, [Sdf.Path(shape.path) for shape in self.shapes if shape.path not in kept], kept)
        for shape in static:
            if not stage.GetPrimAtPath(shape.path).IsA(UsdGeom.Mesh):
                self._turn_into_mesh(shape)
        world = stage.GetDefaultPrim()
        if not world:
            world = UsdGeom.Xform.Define(stage, "/World").GetPrim()
            stage.SetDefaultPrim(world)
        root = UsdGeom.Xform.Define(stage, world.GetPath().AppendChild("Render"))
        if not np.array_equal(UsdGeom.XformCache(self._codes[0]).GetLocalToWorldTransform(world), np.eye(4)):
            root.SetResetXformStack(True)
        UsdGeom.Scope.Define(stage, root.GetPath().AppendChild("Materials"))
        return root.GetPath()

    def _find_shapes(self) -> list[DrawnShape]:
        """Return all solids and meshes of the stage at the first time sample."""
        stage, shapes = self._stage, []
        rows = {path: row for row, path in enumerate(self.recording.bodies)}
        transforms = UsdGeom.XformCache(stage.GetStartTimeCode())
        to_body: dict[str, np.ndarray] = {}
        for prim in stage.Traverse():
            surface = shape_of(prim)
            if surface is None:
                continue
            body = _body_of(prim)
            frame = np.array(transforms.GetLocalToWorldTransform(prim))
            if body:
                path = str(body.GetPath())
                if path not in to_body:
                    to_body[path] = np.linalg.inv(rigid_part(np.array(transforms.GetLocalToWorldTransform(body))))
                frame = frame @ to_body[path]
            shapes.append(_drawn_shape(prim, surface, rows[path] if body else -1, frame))
        return shapes

    def _instanced(self) -> np.ndarray:
        """Return True for bodies that are drawn as instances, shape [n]: moving bodies, dynamic bodies and magnets."""
        record, magnets = self.recording, set(self.recording.magnets)
        instanced = np.ptp(record.positions, axis=0).any(axis=1) | np.ptp(record.rotations, axis=0).any(axis=1)
        for row, path in enumerate(record.bodies):
            prim = self._stage.GetPrimAtPath(path)  # a ball of an instancer has no prim and is dynamic
            flag = prim and prim.GetAttribute("physics:kinematicEnabled")
            instanced[row] |= path in magnets or not (flag and flag.Get())
        return instanced

    def _turn_into_mesh(self, shape: DrawnShape) -> None:
        """Replace the prim of a static solid by a mesh in the same frame."""
        spec = self._stage.GetRootLayer().GetPrimAtPath(shape.path)
        points, faces = shape_of(self._stage.GetPrimAtPath(shape.path))
        for name in _SIZES:
            if name in spec.properties:
                spec.RemoveProperty(spec.properties[name])
        author_mesh(UsdGeom.Mesh.Define(self._stage, shape.path), points, faces)

    def shapes_of_magnets(self) -> list[list[DrawnShape]]:
        """Return the visible shapes of each magnet of the recording, or all shapes if none is visible."""
        magnets: dict[str, list[DrawnShape]] = {path: [] for path in self.recording.magnets}
        for shape in self.shapes:
            path = shape.path
            while path and path not in magnets:
                path = path.rpartition("/")[0]
            if path:
                magnets[path].append(shape)
        for path, shapes in magnets.items():
            if not shapes:
                raise InputError(f"{path}: a magnet without a shape")
        return [[shape for shape in shapes if shape.drawn] or shapes for shapes in magnets.values()]

    def add_bodies(self, shades: np.ndarray | None = None) -> None:
        """Add the bodies, with their own materials or in shades of the color scale, 0 to 1, shape [f, n]."""
        materials = self._author_scale() if shades is not None else None
        record = self.recording
        for name in ("Balls", "Bodies"):
            balls = name == "Balls"
            shapes = [shape for shape in self._moving if bool(shape.radius) == balls]
            if not shapes:
                continue
            rows, path = np.array([shape.row for shape in shapes]), self._root.AppendChild(name)
            paths, indices = self._author_prototypes(path, shapes, shades, materials)
            motion = {"positions": record.positions[:, rows], "velocities": record.linear[:, rows]}
            if balls:
                motion["scales"] = np.array([shape.radius for shape in shapes])
            else:
                motion |= {"orientations": record.rotations[:, rows], "angular_velocities": record.angular[:, rows]}
            instances = InstanceArrays(prototypes=indices, **motion)
            author_instances(self._stage, path, paths, self._codes, instances)

    def _author_prototypes(self, path, shapes, shades, materials) -> tuple[list[Sdf.Path], np.ndarray]:
        """Author the prototypes of shapes; return their paths, and the index of each shape's, shape [k] or [f, k]."""
        if shades is None:
            colors = np.zeros((1, len(shapes)), dtype=int)
        else:
            colors = np.rint(shades[:, [shape.row for shape in shapes]] * (_SHADES - 1)).astype(int)
        indices, prototypes = np.empty(colors.shape, dtype=int), {}
        for column, shape in enumerate(shapes):
            shape_key = _key(shape, with_appearance=shades is None)
            for color in np.unique(colors[:, column]).tolist():
                key = (shape_key, color)
                if key not in prototypes:
                    prototype = path.AppendPath(f"Prototypes/Shape_{len(prototypes):03d}")
                    prototypes[key] = prototype, len(prototypes)
                    self._author_prototype(prototype, shape, materials[color] if materials else None)
                indices[colors[:, column] == color, column] = prototypes[key][1]
        return [prototype for prototype, _ in prototypes.values()], indices[0] if shades is None else indices

    def _author_prototype(self, path: Sdf.Path, shape: DrawnShape, material: UsdShade.Material | None) -> None:
        """Author the mesh of a prototype in the frame of its body, with its own or another material."""
        stage, (own_material, color) = self._stage, shape.appearance
        UsdGeom.Scope.Define(stage, path.GetParentPath())
        source = self._scene.GetPrimAtPath(shape.path)
        if source and source.typeName == "Mesh":  # a ball of an instancer has no prim
            Sdf.CopySpec(self._scene, shape.path, stage.GetRootLayer(), path)
            with Sdf.ChangeBlock():
                _strip(stage.GetRootLayer(), [], drawn=[str(path)], below=path)  # it may be a body itself
            mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
            _transform_to_body(mesh, shape)
        else:
            mesh = UsdGeom.Mesh.Define(stage, path)
            author_mesh(mesh, *(BALL if shape.radius else (shape.points, shape.faces)))
            if color:
                mesh.CreateDisplayColorAttr(Vt.Vec3fArray([Gf.Vec3f(*color)]))
        binding = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
        if material:
            binding.Bind(material)
            mesh.GetDisplayColorAttr().Clear()
        elif own_material:
            binding.Bind(UsdShade.Material(stage.GetPrimAtPath(own_material)))

    def _author_scale(self) -> list[UsdShade.Material]:
        """Author and return the materials of the color scale."""
        materials = []
        for number, color in enumerate(color_scale(_SHADES)):
            path = self._root.AppendPath(f"Materials/Shade_{number:02d}")
            materials.append(UsdShade.Material.Define(self._stage, path))
            author_surface(materials[-1], color=color, roughness=0.35, coat=0.5)
        return materials

    def add_arrows(self, centers: np.ndarray, moments: np.ndarray, lengths: np.ndarray) -> None:
        """Add arrows of given lengths, shape [f, m], at the centers of magnets along their moments, shape [f, m, 3]."""
        path = self._root.AppendChild("Moments")
        mesh = UsdGeom.Mesh.Define(self._stage, path.AppendPath("Prototypes/Arrow"))
        UsdGeom.Scope.Define(self._stage, path.AppendChild("Prototypes"))
        author_mesh(mesh, *ARROW)
        self._paint(mesh.GetPrim(), "Arrow", (0.9, 0.35, 0.02))
        prototypes = np.zeros(moments.shape[1], dtype=int)
        arrows = InstanceArrays(centers, prototypes, orientations=rotations_from_z(moments), scales=lengths)
        author_instances(self._stage, path, [mesh.GetPath()], self._codes, arrows)

    def add_lines(self, points: np.ndarray, width: float) -> None:
        """Add field lines, shape [f, lines, points, 3], as curves of the given width."""
        curves = author_curves(self._stage, self._root.AppendChild("FieldLines"), self._codes, points, width)
        self._paint(curves.GetPrim(), "FieldLine", (0.02, 0.35, 0.8))

    def _paint(self, prim: Usd.Prim, name: str, color: Sequence[float]) -> None:
        material = UsdShade.Material.Define(self._stage, self._root.AppendPath(f"Materials/{name}"))
        author_surface(material, color=color, roughness=0.4)
        UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)
        UsdGeom.Gprim(prim).CreateDisplayColorAttr(Vt.Vec3fArray([Gf.Vec3f(*color)]))

    def save(self, output: str | os.PathLike, *, materialx: bool = False) -> None:
        """Write the stage to a ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file, or as a web page, ``.html``."""
        path = usable_path(output)
        if path.suffix not in _SUFFIXES:
            raise InputError(f"{path}: a stage must end in {', '.join(_SUFFIXES)}, numbers in .npz or .csv")
        if path.resolve() in self._files:
            raise InputError(f"{path}: would overwrite the exported scene")
        if materialx:
            author_materialx(self._stage)
        with Output.errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=f".{path.stem}.", dir=path.parent) as folder:
                file = Path(folder) / (f"{path.stem}.usdc" if path.suffix == ".usdz" else path.name)
                if path.suffix == ".html":
                    written = file.write_text(page_of(self._stage, self._codes, path.stem), encoding="utf-8") > 0
                else:
                    written = self._stage.GetRootLayer().Export(str(file))
                if written and path.suffix == ".usdz":
                    package = Path(folder) / path.name
                    written = UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(file)), str(package))
                    file = package
                if not written:
                    raise InputError(f"{path}: cannot be written")
                os.replace(file, path)
        if known := Sdf.Layer.Find(str(path)):
            known.Reload(force=True)


def _scene_of(source: Usd.Stage, instancers: Sequence[BallInstancer], rate: float) -> Sdf.Layer:
    """Return the scene without the layers of runs, as one layer with ``rate`` time codes per second."""
    # the layer has a prim for each instance, but of ``instancers`` only for balls that differ from the other balls
    root = source.GetRootLayer()
    top = Sdf.Layer.CreateAnonymous(".usda")
    for key in copied_metadata(root):
        top.pseudoRoot.SetInfo(key, root.pseudoRoot.GetInfo(key))
    top.timeCodesPerSecond = top.framesPerSecond = rate
    top.subLayerPaths[:] = [root.identifier]
    stage = Usd.Stage.Open(top)
    for layer in stage.GetUsedLayers():
        if "warpmag" in layer.customLayerData:
            stage.MuteLayer(layer.identifier)
    kept = {instancer.path for instancer in instancers}
    instances = expand_instancers(stage, stage.GetStartTimeCode(), defer=True)
    complete_instances([instance for instance in instances if str(instance.instancer) not in kept])
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        while instances := [prim for prim in stage.Traverse() if prim.IsInstance()]:
            for prim in instances:
                prim.SetInstanceable(False)
    return stage.Flatten(addSourceFileComment=False)


def _strip(
    layer: Sdf.Layer, dropped: Collection[Sdf.Path], drawn: Collection[str] = (), below: Sdf.Path | str = "/"
) -> None:
    """Remove prims and all physics from a layer, and prims that are then empty and not ``drawn``."""
    paths: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path(below), lambda path: paths.append(path) if path.IsPrimPath() else None)
    dropped = set(dropped)
    for path in paths:  # children come before their parents
        spec = layer.GetPrimAtPath(path)
        if spec is None:
            continue
        physical = spec.typeName.startswith(("Physics", "Newton")) or spec.specifier == Sdf.SpecifierClass
        schemas = spec.GetInfo("apiSchemas")
        body = schemas and "PhysicsRigidBodyAPI" in schemas.GetAddedOrExplicitItems()
        siblings = (spec.nameParent or layer.pseudoRoot).nameChildren
        if physical or path in dropped or (body and not spec.nameChildren and str(path) not in drawn):
            del siblings[spec.name]
            continue
        if schemas:
            kept = [name for name in schemas.GetAddedOrExplicitItems() if not name.startswith(_SCHEMAS)]
            spec.SetInfo("apiSchemas", Sdf.TokenListOp.CreateExplicit(kept))
        if spec.typeName == "Scope" and not spec.nameChildren and not spec.properties:
            del siblings[spec.name]
            continue
        for attribute in list(spec.properties):
            if attribute.name.startswith(_SIMULATION_PREFIXES):
                spec.RemoveProperty(attribute)


def _body_of(prim: Usd.Prim) -> Usd.Prim | None:
    """Return the rigid body of a prim: the prim itself or an ancestor."""
    while prim and not prim.IsPseudoRoot():
        if is_body(prim):
            return prim
        prim = prim.GetParent()
    return None


def _drawn_shape(prim: Usd.Prim, surface: Shape, row: int, frame: np.ndarray) -> DrawnShape:
    image = UsdGeom.Imageable(prim)
    drawn = image.ComputeVisibility() != UsdGeom.Tokens.invisible and image.ComputePurpose() in _PURPOSES
    material, color = bound_material(prim), UsdGeom.Gprim(prim).GetDisplayColorAttr().Get()
    appearance = (str(material.GetPath()) if material else "", tuple(color[0]) if color else ())
    gram, radius = frame[:3, :3] @ frame[:3, :3].T, 0.0
    if prim.IsA(UsdGeom.Sphere) and np.allclose(gram, gram[0, 0] * np.eye(3), rtol=0.0, atol=1e-5 * gram[0, 0]):
        radius = float(np.sqrt(gram[0, 0])) * prim.GetAttribute("radius").Get()
        if row < 0 or np.abs(frame[3, :3]).max() < 1e-6 * radius:
            return DrawnShape(str(prim.GetPath()), row, frame, drawn, radius, np.zeros((0, 3)), [], appearance)
    points, faces = surface
    points = np.c_[points, np.ones(len(points))] @ frame[:, :3]
    return DrawnShape(str(prim.GetPath()), row, frame, drawn, 0.0, points, faces, appearance)


def _key(shape: DrawnShape, with_appearance: bool) -> tuple:
    """Return the key of a shape's prototype: shapes with equal keys share one."""
    appearance = shape.appearance if with_appearance else ()
    if shape.radius:
        return ("ball", appearance)
    size = max(shape.size, 1e-30)
    return (np.round(shape.points / size, _DIGITS).tobytes(), round(float(np.log(size)), _DIGITS), appearance)


def _transform_to_body(mesh: UsdGeom.Mesh, shape: DrawnShape) -> None:
    """Transform the points and normals of a mesh into the frame of its body, and remove the mesh's own transform."""
    mesh.ClearXformOpOrder()
    spec = mesh.GetPrim().GetPrimStack()[0]
    for transform in [attribute for attribute in spec.properties if attribute.name.startswith("xformOp")]:
        spec.RemoveProperty(transform)
    mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(shape.points, dtype=np.float32)))
    for name in ("normals", "primvars:normals"):
        normals = mesh.GetPrim().GetAttribute(name)
        if normals and normals.Get() is not None:
            values = np.array(normals.Get(), dtype=float) @ np.linalg.inv(shape.frame[:3, :3]).T
            values /= np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-30)
            normals.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32)))
    box = shape.points.min(axis=0), shape.points.max(axis=0)
    mesh.CreateExtentAttr([Gf.Vec3f(*corner.tolist()) for corner in box])
