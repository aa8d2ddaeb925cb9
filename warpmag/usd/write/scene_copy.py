"""Copies a scene with all its files beside the output of a run."""

import os
import shutil
from pathlib import Path

from pxr import Ar, Sdf, Usd, UsdUtils

from warpmag.errors import InputError
from warpmag.usd.read.session import unsaved_layers
from warpmag.usd.write.output import Output


def copy_scene(stage: Usd.Stage, output: Output) -> tuple[Path, Path]:
    """Write a temporary copy of a stage's scene; return the file or folder, and the root layer of the scene in it.

    A scene of one layer becomes ``out.scene.usdc``, a package ``out.scene.usdz``. A scene with sublayers, references,
    payloads or assets such as textures becomes a folder ``out.scene`` with all files in their relative places. The copy
    includes unsaved edits.
    """
    scene, edited = stage.GetRootLayer(), unsaved_layers(stage)
    for layer in edited:
        if Ar.IsPackageRelativePath(layer.realPath) or layer.GetFileFormat().IsPackage():
            raise InputError(f"{layer.realPath}: has unsaved edits and is in a package, which cannot contain them")
    if scene.GetFileFormat().IsPackage():
        copied = output.beside(".scene.usdz")
        shutil.copyfile(scene.realPath, output.temporary(copied))
        return copied, copied
    layers, assets, _ = ([], [], []) if scene.anonymous else UsdUtils.ComputeAllDependencies(scene.realPath)
    files = {file_with(path) for path in (*(layer.realPath for layer in layers), *assets)}
    if len(files) < 2:
        copied = output.beside(".scene.usdc")
        output.write(scene, copied)
        return copied, copied
    folder = output.beside(".scene")
    top = os.path.commonpath([os.path.dirname(file) for file in files])
    places = {file: output.temporary(folder) / os.path.relpath(file, top) for file in files}
    for file, place in places.items():
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, place)
    for layer in layers:
        if layer.realPath in places:  # not inside a package
            _point_to_copies(layer, places, edited=layer in edited)
    return folder, folder / os.path.relpath(scene.realPath, top)


def file_with(path: str) -> str:
    """Return the file that contains a layer or an asset, which may be a package."""
    return Ar.SplitPackageRelativePathOuter(path)[0]


def _point_to_copies(layer: Sdf.Layer, places: dict[str, Path], *, edited: bool) -> None:
    """Write the copy of ``layer`` with its unsaved edits, and with paths to the other copies."""
    changed = edited
    resolver = Ar.GetResolver()

    def copied_path(path: str) -> str:
        nonlocal changed
        outer, inner = Ar.SplitPackageRelativePathOuter(path)
        if not outer or outer.startswith(("./", "../")):
            return path
        resolved = resolver.Resolve(Sdf.ComputeAssetPathRelativeToLayer(layer, outer)).GetPathString()
        if resolved not in places:
            return path
        changed = True
        short = os.path.relpath(places[resolved], places[layer.realPath].parent)
        short = short if short.startswith("../") else f"./{short}"
        return Ar.JoinPackageRelativePath(short, inner) if inner else short

    copied = Sdf.Layer.CreateAnonymous() if edited else Sdf.Layer.OpenAsAnonymous(layer.realPath)
    if edited:
        copied.TransferContent(layer)
    UsdUtils.ModifyAssetPaths(copied, copied_path)
    if changed:
        copied.Export(str(places[layer.realPath]))
