"""Replaces concave faces of meshes by triangles for Newton's importer, which makes a fan of every face.

The fan of a concave face covers points outside of the face. The triangles are written to the session layer: the scene
and the layers of a run keep the faces of the artist. Values of faces and of their corners follow the triangles.
"""

import numpy as np
from pxr import Usd, UsdGeom, Vt

from warpmag.declarations.checks import check_flag
from warpmag.errors import InputError
from warpmag.shapes.polygons import faces_of_triangles, fans, triangulate
from warpmag.usd.read.prims import is_collider
from warpmag.usd.read.session import editable, instance_findings, instances_around
from warpmag.usd.values import check_stage


def triangulate_concave_faces(stage: Usd.Stage, *, visuals: bool = True) -> None:
    """Replace meshes with concave faces by triangles, in the session layer of a stage without errors.

    Args:
        stage: The stage, as :func:`open_stage` returns it.
        visuals: Also replace meshes that do not collide.

    Raises:
        InputError: A concave face is in an instance with an override that USD ignores, or an argument is wrong.
    """
    check_stage(stage)
    check_flag("visuals", visuals)
    prims = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
    meshes = [prim.GetPath() for prim in prims if prim.IsA(UsdGeom.Mesh) and (visuals or is_collider(prim))]
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for path in meshes:
            mesh = UsdGeom.Mesh.Get(stage, path)
            attributes = mesh.GetPointsAttr(), mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()
            points, counts, indices = (np.array(attribute.Get() or ()) for attribute in attributes)
            if not len(points) or counts.max(initial=0) <= 3:
                continue
            corners = triangulate(points, counts, indices)
            if (corners != fans(counts)).any():
                for finding in instance_findings(instances_around([mesh.GetPrim()])):
                    raise InputError(str(finding))
                _replace_faces(UsdGeom.Mesh(editable(stage, path)), corners, counts, indices)


def _replace_faces(mesh: UsdGeom.Mesh, corners: np.ndarray, counts: np.ndarray, indices: np.ndarray) -> None:
    """Replace the faces of a mesh by triangles with the given corners, shape [k, 3]."""
    faces = faces_of_triangles(counts)
    sources = {
        UsdGeom.Tokens.faceVarying: (corners.reshape(-1), len(indices)),
        UsdGeom.Tokens.uniform: (faces, len(counts)),
    }
    for primvar in UsdGeom.PrimvarsAPI(mesh).GetPrimvarsWithValues():
        rows, size = sources.get(primvar.GetInterpolation(), (None, 0))
        if rows is None:
            continue
        count = len(primvar.Get()) // primvar.GetElementSize()
        elements = np.array(primvar.GetIndices()) if primvar.IsIndexed() else np.arange(count)
        if len(elements) == size:  # values of another length have no meaning, and Newton drops them
            primvar.SetIndices(_ints(elements[rows]))
    normals = np.array(mesh.GetNormalsAttr().Get() or ())
    rows, size = sources.get(mesh.GetNormalsInterpolation(), (None, 0))
    if rows is not None and len(normals) == size:
        mesh.GetNormalsAttr().Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals[rows], np.float32)))
    for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh):
        if subset.GetElementTypeAttr().Get() == UsdGeom.Tokens.face:
            _follow_faces(subset.GetIndicesAttr(), faces)
    _follow_faces(mesh.GetHoleIndicesAttr(), faces)
    mesh.GetFaceVertexCountsAttr().Set(Vt.IntArray(len(corners), 3))
    mesh.GetFaceVertexIndicesAttr().Set(_ints(indices[corners.reshape(-1)]))


def _follow_faces(attribute: Usd.Attribute, faces: np.ndarray) -> None:
    """Replace faces in an attribute by their triangles; ``faces`` has the face of each triangle."""
    if chosen := attribute.Get():
        attribute.Set(_ints(np.flatnonzero(np.isin(faces, np.array(chosen)))))


def _ints(values: np.ndarray) -> Vt.IntArray:
    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values, np.int32))
