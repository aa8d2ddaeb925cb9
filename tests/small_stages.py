"""Small stages in words, and what both commands say about one."""

from warpmag import cli

G = 9.81  # m/s²
R = 0.005  # m
IRON = 7870.0  # kg/m³
HEAD = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    timeCodesPerSecond = 60
    startTimeCode = 0
    endTimeCode = 60
)
"""
PERMANENT = 'uniform token warpmag:kind = "permanent"\n vector3f warpmag:magnetization = (0, 0, 1e6)\n'
FIELD = (0.0, 0.0, 1000.0)  # A/m: far from saturation


def physics(gravity=G, field=(0.0, 0.0, 0.0), name="Scene"):
    return f"""def PhysicsScene "{name}" (prepend apiSchemas = ["WarpmagSceneAPI"]) {{
    vector3f physics:gravityDirection = (0, 0, -1)
    float physics:gravityMagnitude = {gravity}
    vector3f warpmag:externalField = {field}
}}
"""


def ball(name, place, lines="", radius=R, magnet=True, body=True, kinematic=False):
    schemas = ["PhysicsCollisionAPI", "PhysicsMassAPI"]
    schemas += ["PhysicsRigidBodyAPI"] * body + ["WarpmagMagnetAPI"] * magnet
    return f"""def Sphere "{name}" (prepend apiSchemas = {str(schemas).replace("'", '"')}) {{
    double radius = {radius}
    float physics:density = {IRON}
    double3 xformOp:translate = {place}
    uniform token[] xformOpOrder = ["xformOp:translate"]
    {"bool physics:kinematicEnabled = 1" if kinematic else ""}
    {lines}
}}
"""


def joint(kind, body0, body1, place0, place1, lines="", name="Joint"):
    """A joint about the y axis between prims of the world, or None for the world itself."""
    bodies = [f"rel physics:body{k} = </World/{prim}>" for k, prim in enumerate((body0, body1)) if prim]
    axis = 'uniform token physics:axis = "Y"' if kind in ("Revolute", "Prismatic") else ""
    return f"""def Physics{kind}Joint "{name}" {{
    {chr(10).join([*bodies, axis])}
    point3f physics:localPos0 = {place0}
    point3f physics:localPos1 = {place1}
    quatf physics:localRot0 = (1, 0, 0, 0)
    quatf physics:localRot1 = (1, 0, 0, 0)
    {lines}
}}
"""


def write(folder, *parts):
    path = folder / "scene.usda"
    path.write_text(HEAD + 'def Xform "World" {\n' + "".join(parts) + "}\n")
    return path


def errors_and_warnings(path, folder, device, capsys, frames=2):
    """Return the errors and the warnings of ``check``, after a test that ``run`` reports the same."""
    capsys.readouterr()
    code = cli.main(["check", str(path)])
    lines = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()]
    checked = {kind: [rest for name, rest in lines if name == kind] for kind in ("error", "warning")}
    command = ["run", str(path), "-o", str(folder / "out.usda"), "--frames", str(frames), "--device", device]
    assert cli.main([*command, "--overwrite"]) == code
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warpmag: ")]
    ran = [line.removeprefix("warpmag: warning: ") for line in lines if line.startswith("warpmag: warning: ")]
    refused = [line.removeprefix("warpmag: ") for line in lines if not line.startswith("warpmag: warning: ")]
    assert code == (cli.BAD_INPUT if checked["error"] else 0)
    assert refused == checked["error"][:1]
    if not refused:
        assert ran == checked["warning"]
    return checked["error"], checked["warning"]


A, B, C = (ball(name, (0.05 * k, 0.0, 1.0)) for k, name in enumerate("ABC"))
RIGHT, LEFT = (0.025, 0.0, 0.0), (-0.025, 0.0, 0.0)
CHAIN = [joint("Spherical", *bodies, RIGHT, LEFT, name=bodies) for bodies in ("AB", "BC")]
