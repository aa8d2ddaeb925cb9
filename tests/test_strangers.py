"""What ``SECURITY.md`` says of a stage from a stranger."""

import http.server
import threading

import pytest
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

from warpmag.engine.stepping.scene import import_scene
from warpmag.errors import InputError
from warpmag.scenes_usd import balls_up
from warpmag.usd import check

PICTURES = pytest.importorskip("PIL.Image")


@pytest.fixture
def server():
    """Address of a server on this machine, and what it was asked for."""
    asked = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_error(404)

        def log_message(self, *_):
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/picture.png", asked
        server.shutdown()


def textured(path, texture, kind=Sdf.ValueTypeNames.Asset):
    """A Balls Up of one ball, and a tetrahedron whose colour is a texture that Newton reads at once."""
    balls_up.author(path, columns=1, rows=1, layers=1)
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh.Define(stage, "/World/Thing/Mesh")
    mesh.CreatePointsAttr([(1, 0, 0), (1, 1, 0), (1, 0, 1), (2, 0, 0)])
    mesh.CreateFaceVertexCountsAttr([3] * 4)
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 0, 2, 3, 0, 3, 1, 1, 3, 2])
    corners = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
    corners.Set([(0, 0), (1, 0), (0, 1), (1, 1)])
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    material = UsdShade.Material.Define(stage, "/World/Thing/Material")
    surface, picture = (UsdShade.Shader.Define(stage, f"/World/Thing/Material/{n}") for n in ("Surface", "Picture"))
    surface.CreateIdAttr("UsdPreviewSurface")
    picture.CreateIdAttr("UsdUVTexture")
    picture.CreateInput("file", kind).Set(texture)
    picture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("raw")
    picture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    color = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    color.ConnectToSource(picture.ConnectableAPI(), "rgb")
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()
    return stage


def shapes_with_texture(path):
    meshes = import_scene(path, visuals=True).builder.shape_source
    return [mesh for mesh in meshes if getattr(mesh, "texture", None) is not None]


@pytest.mark.parametrize("kind", ["Asset", "String"])
def test_nothing_is_fetched_from_a_network(server, kind, tmp_path):
    address, asked = server
    textured(tmp_path / "scene.usda", address, getattr(Sdf.ValueTypeNames, kind))
    report = check(tmp_path / "scene.usda")
    assert not report.errors
    assert kind == "String" or any("unresolvable external dependency" in str(one) for one in report.warnings)
    assert not shapes_with_texture(tmp_path / "scene.usda")
    assert asked == []


def test_nor_for_an_instance(server, tmp_path):
    address, asked = server
    stage = textured(tmp_path / "scene.usda", address)
    again = stage.DefinePrim("/World/Again")
    again.GetReferences().AddInternalReference("/World/Thing")
    again.SetInstanceable(True)
    stage.GetRootLayer().Save()
    with pytest.raises(InputError, match="/World/Again/Material/Picture: inputs:file is 'http://.*inside an instance"):
        import_scene(tmp_path / "scene.usda")
    assert asked == []


def test_a_texture_in_a_file_is_read(tmp_path):
    PICTURES.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "picture.png")
    textured(tmp_path / "scene.usda", "./picture.png")
    assert shapes_with_texture(tmp_path / "scene.usda")
