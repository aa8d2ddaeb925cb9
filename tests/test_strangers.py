"""What ``SECURITY.md`` says of a stage from a stranger."""

import http.server
import itertools
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

from warpmag.engine.stepping.scene import import_scene
from warpmag.errors import InputError
from warpmag.scenes_usd import balls_up
from warpmag.usd import check
from warpmag.usd.read.trial_read import irregular_file

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
    assert kind == "String" or any("unresolvable external dependency" in str(warning) for warning in report.warnings)
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


CHAINS = {
    "the input": [],
    "an input of the material": ["/World/Thing/Material.inputs:chosen"],
    "an output": ["/World/Thing/Material/Values.outputs:chosen"],
    "a chain": ["/World/Thing/Material.inputs:chosen", "/World/Thing/Material/Values.outputs:chosen"],
    "an output of a prim without a type": ["/World/Thing/Material/Plain.outputs:chosen"],
}
KINDS = ("Asset", "String", "Token")


def chained(path, texture, kind, chain, sampled):
    """A stage whose texture is behind connections, perhaps in a time sample."""
    kind = getattr(Sdf.ValueTypeNames, kind)
    stage = textured(path, "", kind)
    UsdShade.NodeGraph.Define(stage, "/World/Thing/Material/Values")
    stage.DefinePrim("/World/Thing/Material/Plain")
    attribute = stage.GetAttributeAtPath("/World/Thing/Material/Picture.inputs:file")
    attribute.Clear()
    for target in chain:
        attribute.AddConnection(target)
        prim, _, name = target.partition(".")
        attribute = stage.GetPrimAtPath(prim).CreateAttribute(name, kind)
    attribute.Set(texture, 0.0) if sampled else attribute.Set(texture)
    stage.GetRootLayer().Save()


@pytest.fixture
def opened(monkeypatch):
    """Names of the pictures that are opened; none is read."""
    names = []

    def record(file, *_, **__):
        names.append(str(file))
        raise OSError("not read")

    monkeypatch.setattr(PICTURES, "open", record)
    return names


def crossed(rows, columns):
    """Pairs of a row and a column; pairs of neither the first row nor the first column are marked ``long``."""
    first_row, first_column, cases = next(iter(rows)), next(iter(columns)), []
    for row, column in itertools.product(rows, columns):
        is_short = row == first_row or column == first_column
        cases.append(pytest.param(row, column, marks=() if is_short else pytest.mark.long))
    return cases


@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.parametrize("kind", KINDS)
def test_no_texture_is_fetched_or_read_from_a_device(kind, chain, server, opened, tmp_path, request):
    """Neither an address of a network, nor a pipe, under any name; every other one is time-sampled.

    Without ``--long`` a third of the names: each of them in some chain of each kind, and of some kind in each chain.
    """
    first = [*CHAINS].index(chain) + [*KINDS].index(kind)
    address, asked = server
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "link.png").symlink_to("pipe.png")
    pipe = str(tmp_path / "pipe.png")
    names = (address, address.upper().replace("HTTP", "Http"), "/dev/stdin", "/dev/zero", pipe, "./pipe.png")
    names += ("./link.png", f"file:{pipe}", f"file://{pipe}", f"FILE:{pipe}", "file:%2Fdev%2Fstdin", "/proc/kmsg")
    numbered = [*enumerate(names, first)]
    for number, name in numbered if request.config.getoption("--long") else numbered[first % 3 :: 3]:
        chained(tmp_path / "scene.usda", name, kind, CHAINS[chain], sampled=number % 2 == 0)
        try:
            shapes_with_texture(tmp_path / "scene.usda")
        except InputError as error:
            assert "is not a regular file" in str(error)
        assert (asked, opened) == ([], []), name


@pytest.mark.parametrize(("kind", "chain"), crossed(KINDS, CHAINS))
def test_a_texture_in_a_file_is_read_behind_connections(kind, chain, opened, tmp_path):
    """The allow list keeps what it should: the same chains with a regular file."""
    PICTURES.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "picture.png")
    chained(tmp_path / "scene.usda", str(tmp_path / "picture.png"), kind, CHAINS[chain], sampled=False)
    import_scene(tmp_path / "scene.usda", visuals=True)
    assert set(opened) == {str(tmp_path / "picture.png")}


LAYERS = {
    "sublayer": ("subLayers = [@./odd.usda@]", ""),
    "reference": ("", "references = @./odd.usda@"),
    "payload": ("", "payload = @./odd.usda@"),
    "reference of a variant": ("", 'variants = {string v = "a"}\n prepend variantSets = "v"'),
    "clip": ("", 'clips = {dictionary a = {asset[] assetPaths = [@./odd.usda@]\n string primPath = "/A"}}'),
    "manifest": ("", 'clips = {dictionary a = {asset manifestAssetPath = @./odd.usda@\n string primPath = "/A"}}'),
    "template of clips": (
        "",
        'clips = {dictionary a = {string templateAssetPath = "./odd.#.usda"\n double templateStartTime = 1\n'
        'double templateEndTime = 2\n double templateStride = 1\n string primPath = "/A"\n}}',
    ),
    "layer of a layer": ("subLayers = [@./between.usda@]", ""),
}
IRREGULAR = {"pipe": None, "link to a pipe": "pipe", "link to a device": "/dev/stdin", "link to zeros": "/dev/zero"}


def odd_stage(folder, place, kind):
    """A stage that names a layer that is no regular file."""
    of_layer, of_prim = LAYERS[place]
    variants = 'variantSet "v" = {"a" {\n}\n"b" (references = @./odd.usda@) {\n}\n}' if "variant" in place else ""
    header = f"#usda 1.0\n({of_layer}\n)\n"
    (folder / "scene.usda").write_text(f'{header}def Xform "A" ({of_prim}) {{\ndouble x\n{variants}\n}}\n')
    (folder / "between.usda").write_text("#usda 1.0\n(subLayers = [@./odd.usda@])\n")
    os.mkfifo(folder / "pipe")
    for name in ("odd.usda", "odd.1.usda"):
        if IRREGULAR[kind] is None:
            os.mkfifo(folder / name)
        else:
            (folder / name).symlink_to(IRREGULAR[kind])
    return folder / "scene.usda"


@pytest.mark.parametrize(("place", "kind"), crossed(LAYERS, IRREGULAR))
def test_no_layer_is_read_from_a_device(place, kind, tmp_path):
    """Refused in one line, in seconds, with a standard input that never ends."""
    path = odd_stage(tmp_path, place, kind)
    reader, writer = os.pipe()
    command = [sys.executable, "-m", "warpmag.cli", "check", str(path)]
    began = time.monotonic()
    try:
        result = subprocess.run(command, stdin=reader, capture_output=True, text=True, timeout=60, check=False)
    finally:
        os.close(reader)
        os.close(writer)
    assert result.returncode == 2 and "is not a regular file" in result.stderr, result.stderr
    assert result.stderr.count("\n") == 1 and time.monotonic() - began < 30.0


def test_a_path_behind_links_that_cannot_be_read_is_no_file(monkeypatch):
    """As ``/proc/1/root/scene.usda`` is to all users but root."""

    def realpath(path):
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr(os.path, "realpath", realpath)
    assert "is not a regular file" in irregular_file("scene.usda")


@pytest.mark.parametrize("kind", ["pipe", "socket"])
def test_a_pipe_or_socket_without_a_name_is_no_file(kind, tmp_path):
    """``/dev/stdin`` leads to one in a pipeline; it waited there for a key, as the value of a shader of type string."""
    ends = os.pipe() if kind == "pipe" else [end.detach() for end in socket.socketpair()]
    try:
        name = f"/proc/self/fd/{ends[0]}"
        (tmp_path / "link.png").symlink_to(name)
        for path in (name, f"/dev/fd/{ends[0]}", tmp_path / "link.png"):
            assert irregular_file(path) == f"{path} is not a regular file"
    finally:
        for end in ends:
            os.close(end)
    assert irregular_file(name) == ""  # a missing file, which USD reports


@pytest.mark.parametrize("kind", IRREGULAR)
def test_the_stage_itself_is_a_file(kind, tmp_path):
    odd_stage(tmp_path, "sublayer", kind)
    for function in (check, import_scene):
        with pytest.raises(InputError, match="no such file|is not a regular file"):
            function(tmp_path / "odd.usda")


def listed(names, more=""):
    """A stage of one rigid body with long lists."""
    header = '#usda 1.0\n(\nmetersPerUnit = 1\nupAxis = "Z"\n)\n'
    return f'{header}def Xform "A" (\nprepend apiSchemas = [{names}]\n{more}\n)\n{{\n'


def clips(start, end, stride):
    return (
        'clips = {dictionary a = {string templateAssetPath = "./odd.#.usda"\n '
        f"double templateStartTime = {start}\n double templateEndTime = {end}\n double templateStride = {stride}\n"
        'string primPath = "/A"\n}}'
    )


def operations(names):
    values = "".join(f"double3 {name} = (0, 0, 0)\n" for name in sorted(set(names)))
    return listed('"PhysicsRigidBodyAPI"') + values + f"uniform token[] xformOpOrder = {names}\n}}\n".replace("'", '"')


ENDLESS = {
    "clips": (
        listed('"PhysicsRigidBodyAPI"', clips(0, "1e12", 1)) + "}\n",
        "/A has a template of more than 100000 clips",
    ),
    "clips by a small stride": (
        listed('"PhysicsRigidBodyAPI"', clips(0, 10, "1e-9")) + "}\n",
        "/A has a template of more than",
    ),
    "clips without an end": (
        listed('"PhysicsRigidBodyAPI"', clips(0, "inf", 1)) + "}\n",
        "/A has a template of more than",
    ),
    "schemas": (
        listed(", ".join(f'"CollectionAPI:c{n}"' for n in range(20_000))) + "}\n",
        "/A has 20000 applied API schemas, at most 1000",
    ),
    "operations": (operations([f"xformOp:translate:a{n}" for n in range(100_000)]), "/A: has 100000 transform operat"),
    "one operation again": (operations(["xformOp:translate"] * 100_000), "/A: has 100000 transform operations"),
    "schemas without a meaning": (listed(", ".join(f'"Odd{n}API"' for n in range(900))) + "}\n", "no magnets"),
}


@pytest.mark.parametrize("case", ENDLESS)
def test_long_lists_end(case, tmp_path):
    """A few seconds, with one line; USD and Newton would take minutes, or for ever."""
    text, message = ENDLESS[case]
    (tmp_path / "scene.usda").write_text(text)
    command = [sys.executable, "-m", "warpmag.cli", "check", str(tmp_path / "scene.usda")]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 2 and message in result.stderr + result.stdout


SLOW_MODULE = """import os, signal, sys, time
try:
    os.kill(os.getpid(), {number})
    time.sleep(5.0)
except BaseException:
    print("went on")
"""


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT", "SIGHUP"])
def test_a_signal_during_an_import(name, tmp_path):
    """Native modules that are half imported swallow exceptions or raise others, and a run would go on."""
    number = int(getattr(signal, name))
    (tmp_path / "slow_module.py").write_text(SLOW_MODULE.format(number=number))
    program = (
        "import importlib, signal, sys; from warpmag import cli; sys.path.insert(0, sys.argv[1]);"
        f"number = signal.Signals({number});"
        "signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL);"
        "cli._materials = lambda _: importlib.import_module('slow_module'); sys.exit(cli.main(['materials']))"
    )
    command = [sys.executable, "-c", program, str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    reason = "interrupted" if name == "SIGINT" else f"ended by {name}"
    assert (result.returncode, result.stderr, result.stdout) == (128 + number, f"warpmag: {reason}\n", "")


def test_an_interrupt_while_the_command_is_imported():
    """It ends silently, as programs in C do, and the handler is Python's own afterwards."""
    program = (
        "import os, signal, sys\n"
        "class Finder:\n"
        "    def find_spec(name, *_):\n"
        "        if name == 'warpmag.command_options' and len(sys.argv) > 1:\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "sys.meta_path.insert(0, Finder)\n"
        "import warpmag.cli\n"
        "assert signal.getsignal(signal.SIGINT) is signal.default_int_handler"
    )
    for arguments, code in (([], 0), (["interrupted"], -signal.SIGINT)):
        command = [sys.executable, "-c", program, *arguments]
        result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert (result.returncode, result.stderr) == (code, "")


@pytest.mark.parametrize(
    ("first", "message"),
    [
        ('"PhysicsMaterialAPI", "PhysicsCollisionAPI"', "PhysicsMaterialAPI is applied before PhysicsCollisionAPI"),
        ('"PhysicsCollisionAPI", "PhysicsMaterialAPI"', ""),
    ],
)
def test_a_collider_that_physics_takes_for_a_material(first, message, tmp_path):
    """USD's physics reads the first of its schemas alone if that is the material's: the collider would be missing."""
    wall = f'def Cube "Wall" (apiSchemas = [{first}]) {{\ndouble size = 0.1\n}}\n'
    balls_up.author(tmp_path / "scene.usda", columns=1, rows=1, layers=1)
    path = tmp_path / "wall.usda"
    path.write_text(f'#usda 1.0\n(\nsubLayers = [@./scene.usda@]\nmetersPerUnit = 1\nupAxis = "Z"\n)\n{wall}')
    errors = [str(error) for error in check(path).errors]
    assert [message in error for error in errors] == ([True] if message else [])
    if not message:
        assert "/Wall" in import_scene(path).builder.shape_label


@pytest.mark.parametrize(("scale", "refused"), [("1e-6, 10, 1", True), ("1e-4, 10, 1", False)])
def test_scales_that_usd_reads_wrongly(scale, refused, tmp_path):
    """``Gf.Transform`` makes 1e-10 of scales below 1e-5: the mass would be 10,000 times too small."""
    balls_up.author(tmp_path / "scene.usda", columns=1, rows=1, layers=1)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usda"))
    cube = stage.DefinePrim("/World/Foil", "Cube")
    for api in (UsdPhysics.RigidBodyAPI, UsdPhysics.CollisionAPI):
        api.Apply(cube)
    UsdPhysics.MassAPI.Apply(cube).CreateDensityAttr(1000.0)
    UsdGeom.Xformable(cube).AddScaleOp(precision=UsdGeom.XformOp.PrecisionDouble).Set(
        tuple(map(float, scale.split(",")))
    )
    stage.GetRootLayer().Save()
    path = str(tmp_path / "scene.usda")
    if refused:
        with pytest.raises(InputError, match="/World/Foil: transform has a scale of less than 1.1e-05"):
            import_scene(path)
    else:
        scene = import_scene(path)
        assert scene.builder.body_mass[scene.bodies["/World/Foil"]] == pytest.approx(1000.0 * 8.0 * 1e-3, rel=1e-5)
