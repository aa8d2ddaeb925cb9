"""The bundled scenes beside Balls Up: what they hold, that nothing overlaps, what Newton and a run make of them."""

import importlib
import importlib.util
import math

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdLux

from warpmag.declarations.magnets import MagneticSettings
from warpmag.errors import InputError
from warpmag.scenes_usd import (
    alphabets,
    authoring,
    balls_up,
    bundled,
    crystal_balls,
    falling_magnet,
    make,
    million,
    sakura_tree,
)
from warpmag.usd import check, open_stage, read_magnets

pytestmark = pytest.mark.no_cover  # of scenes_usd/ no lines are counted
needs_outlines = pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="the letters' outlines")
MAGNET_ATTRIBUTES = ("kind", "saturationMagnetization", "susceptibility", "curve", "magnetization", "momentSpacing")
SCENES = ("alphabets", "balls_up", "crystal_balls", "falling_magnet", "sakura_tree")
CONTENTS = {  # bodies, kinematic bodies, inducible and permanent magnets
    "alphabets": (100, 0, 100, 1),
    "balls_up": (244, 1, 243, 1),
    "crystal_balls": (179, 179, 178, 1),
    "falling_magnet": (1033, 0, 1032, 1),
    "sakura_tree": (2501, 1, 2500, 110),
}


@pytest.fixture(scope="module", params=SCENES)
def report(request):
    return request.param, check(bundled()[request.param])


def test_every_scene_is_bundled():
    assert sorted(bundled()) == sorted(SCENES)


def test_scenes_hold_what_the_paper_names(report):
    name, result = report
    assert [str(finding) for finding in result.findings] == []
    contents = result.contents
    counts = (
        len(contents.bodies),
        len(contents.kinematic),
        *(len(result.magnets(k)) for k in ("inducible", "permanent")),
    )
    assert counts == CONTENTS[name]
    assert contents.settings == MagneticSettings()
    assert (result.clock.step, result.clock.frames_per_second, result.up_axis) == (1e-3, 60.0, "Z")
    assert (result.meters_per_unit, result.kilograms_per_unit) == (1.0, 1.0)


def test_every_magnet_says_all_of_itself(report):
    name, result = report
    stage = open_stage(bundled()[name])
    for path in result.contents.magnets:
        prim = stage.GetPrimAtPath(path)
        for attribute in (
            "kind",
            "saturationMagnetization",
            "susceptibility",
            "curve",
            "magnetization",
            "momentSpacing",
        ):
            assert prim.GetAttribute(f"warpmag:{attribute}").HasAuthoredValue()


def test_scenes_can_be_looked_at(report):
    stage = open_stage(bundled()[report[0]])
    camera = UsdGeom.Camera.Get(stage, "/World/Camera").GetCamera(0.0)
    boxes = UsdGeom.BBoxCache(0.0, [UsdGeom.Tokens.default_])
    ground = stage.GetPrimAtPath("/World/Ground")
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Gprim) and UsdGeom.Imageable(prim).ComputePurpose() == UsdGeom.Tokens.default_:
            middle = boxes.ComputeWorldBound(prim).ComputeCentroid()
            assert prim == ground or camera.frustum.Intersects(middle), prim.GetPath()


def test_scenes_are_lit_typed_and_filmed_in_their_units(report):
    """A film of 36 mm in tenths of the stage's metres, focused on what it looks at; a sky, and lamps of set sizes."""
    stage = open_stage(bundled()[report[0]])
    assert [prim.GetPath() for prim in stage.Traverse() if not prim.GetTypeName()] == []
    camera = UsdGeom.Camera.Get(stage, "/World/Camera")
    assert camera.GetHorizontalApertureAttr().Get() == pytest.approx(0.36)
    assert 0.2 < camera.GetFocalLengthAttr().Get() < 2.0 and camera.GetFStopAttr().Get() > 0.0
    assert camera.GetClippingRangeAttr().Get()[0] < camera.GetFocusDistanceAttr().Get()
    lights = [prim for prim in stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)]
    assert sorted(prim.GetTypeName() for prim in lights) == ["DomeLight", "RectLight", "RectLight"]
    for light in map(UsdLux.LightAPI, lights):
        assert 0.0 < light.GetIntensityAttr().Get() < 20.0
        assert light.GetPrim().IsA(UsdLux.DomeLight) or light.GetNormalizeAttr().HasAuthoredValue()
    codes = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    assert codes == tuple(map(round, codes)) and stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond()


def _specs(layer):
    results = {}

    def visit(path):
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.AttributeSpec):
            results[str(path)] = spec.default
        elif isinstance(spec, Sdf.RelationshipSpec):
            results[str(path)] = [str(target) for target in spec.targetPathList.GetAddedOrExplicitItems()]
        elif isinstance(spec, Sdf.PrimSpec):
            results[str(path)] = (spec.typeName, str(spec.GetInfo("apiSchemas")), spec.specifier)

    layer.Traverse("/", visit)
    return results


@pytest.mark.parametrize("name", [pytest.param("alphabets", marks=needs_outlines), *SCENES[1:]])
def test_bundled_stages_are_what_the_scripts_author(name, tmp_path):
    importlib.import_module(f"warpmag.scenes_usd.{name}").author(tmp_path / "new.usdc")
    new = _specs(Sdf.Layer.OpenAsAnonymous(str(tmp_path / "new.usdc")))
    old = _specs(Sdf.Layer.OpenAsAnonymous(str(bundled()[name])))
    assert new.keys() == old.keys()
    for path, value in new.items():
        if isinstance(value, (float, int)) or (hasattr(value, "__len__") and np.array(value).dtype.kind in "fi"):
            numbers, expected = np.array(value), np.array(old[path])
            if not np.array_equal(numbers, expected):  # much faster
                # single precision, and sums in an order that may differ between machines
                np.testing.assert_allclose(numbers, expected, rtol=1e-6, atol=1e-7, err_msg=path)
        else:
            assert str(value) == str(old[path]), path


def _balls(stage):
    """Centres and radii of all spheres."""
    cache = UsdGeom.XformCache(0.0)
    spheres = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Sphere)]
    centers = np.array([cache.GetLocalToWorldTransform(prim).ExtractTranslation() for prim in spheres])
    return centers, np.array([UsdGeom.Sphere(prim).GetRadiusAttr().Get() for prim in spheres])


def _least_gap(centers, radii):
    """Return the smallest distance between the surfaces of two balls."""
    least = math.inf
    for start in range(0, len(centers), 256):
        rows = slice(start, start + 256)
        gaps = np.linalg.norm(centers[rows, None] - centers, axis=2) - radii[rows, None] - radii
        gaps[np.arange(len(gaps)), np.arange(start, start + len(gaps))] = math.inf
        least = min(least, gaps.min())
    return least


@pytest.mark.parametrize("name", ["balls_up", "crystal_balls", "falling_magnet", "sakura_tree"])
def test_no_ball_overlaps_another_or_the_ground(name):
    stage = open_stage(bundled()[name])
    centers, radii = _balls(stage)
    assert _least_gap(centers, radii) > 0.0
    if stage.GetPrimAtPath("/World/Ground"):
        assert (centers[:, 2] - radii).min() > -1e-9


def test_letters_of_the_grid_are_apart():
    stage = open_stage(bundled()["alphabets"])
    boxes = UsdGeom.BBoxCache(0.0, [UsdGeom.Tokens.default_, UsdGeom.Tokens.guide])
    ranges = [
        boxes.ComputeWorldBound(entry).ComputeAlignedRange()
        for entry in stage.GetPrimAtPath("/World/Letters").GetChildren()
    ]
    lower, upper = (
        np.array([pick(entry) for entry in ranges]) for pick in (lambda r: r.GetMin(), lambda r: r.GetMax())
    )
    apart = np.maximum(lower[:, None] - upper, lower - upper[:, None]).max(axis=2)
    assert apart[~np.eye(100, dtype=bool)].min() > 1e-4
    np.testing.assert_allclose(lower.min(axis=0) + upper.max(axis=0), 0.0, atol=5e-3)


def test_every_ball_of_the_stack_rests_on_four():
    radius = 0.005
    for count, layers in ((1032, 6), (333, 20), (50, 1)):
        places = falling_magnet.stack(count, layers, radius)
        assert len(np.unique(places.round(9), axis=0)) == count
        assert len(np.unique(places[:, 2].round(9))) <= layers
        distances = np.linalg.norm(places[:, None] - places, axis=2)
        touching = (distances < 1.001 * authoring.BALL_SPACING * radius) & (places[:, None, 2] > places[:, 2] + radius)
        assert (touching.sum(axis=1)[places[:, 2] > 2.0 * radius] == 4).all()


def test_trees_are_whole_tapered_and_reproducible():
    grown = [sakura_tree.grow(180, 0.4, 0.004, np.random.default_rng(seed)) for seed in (7, 7, 8)]
    tree = grown[0]
    np.testing.assert_array_equal(tree.nodes, grown[1].nodes)
    assert tree.nodes.shape != grown[2].nodes.shape or (tree.nodes != grown[2].nodes).any()
    assert (tree.parents[1:] < np.arange(1, len(tree.nodes))).all() and tree.parents[0] == -1
    assert (tree.parents[1:] >= 0).all()
    thicker = tree.radii[tree.parents[2:]] >= tree.radii[2:]
    assert thicker.all() and (tree.radii[tree.tips] == tree.radii.min()).all()
    tips = tree.nodes[tree.tips]
    assert _least_gap(tips, np.full(len(tips), 0.004)) > 0.0
    lengths = np.linalg.norm(tree.nodes[1:] - tree.nodes[tree.parents[1:]], axis=1)
    assert lengths.min() > 0.0 and 0.3 < tree.nodes[:, 2].max() < 0.45


@pytest.mark.parametrize("strength,field", [("strong", 4e7), ("weak", 1e6)])
def test_crystal_balls_have_a_strong_and_a_weak_magnet(tmp_path, strength, field):
    stage = open_stage(bundled()["crystal_balls"])
    assert read_magnets(stage).magnets["/World/Magnet"].magnetization == (4e7, 0.0, 0.0)
    stage.GetPrimAtPath("/World/Magnet").GetVariantSet("strength").SetVariantSelection(strength)
    assert read_magnets(stage).magnets["/World/Magnet"].magnetization == (field, 0.0, 0.0)
    crystal_balls.author(tmp_path / "scene.usdc", strength=strength)
    assert check(tmp_path / "scene.usdc").contents.magnets["/World/Magnet"].magnetization == (field, 0.0, 0.0)


def test_other_counts_and_sizes(tmp_path):
    path = tmp_path / "scene.usdc"
    falling_magnet.author(path, balls=61, layers=3, radius=0.003, magnet_radius=0.01, friction=0.2)
    result = check(path)
    assert len(result.magnets("inducible")) == 61 and not result.findings
    sakura_tree.author(path, balls=700, branches=12, radius=0.002, height=0.3, spacing=0.012, seed=1)
    result = check(path)
    assert len(result.magnets("inducible")) == 700 and not result.findings
    assert 3 <= len(result.magnets("permanent")) <= 12
    assert _least_gap(*_balls(open_stage(path))) > 0.0
    crystal_balls.author(path, columns=5, rows=7, bar=1, bar_rows=1)
    result = check(path)
    assert len(result.magnets("inducible")) == 34 and not result.findings


def test_very_many_balls_are_instances_apart(tmp_path):
    places = sakura_tree.rain(11_000, 0.005, 0.022, 0.4, np.random.default_rng(1))
    assert places.shape == (11_000, 3)
    assert (np.diff(places[:, 2].round(2)) >= -0.02).all()
    some = places[:2000]
    assert _least_gap(some, np.full(len(some), 0.005)) > 0.0
    assert (
        _least_gap(cloud := million.cloud(1500, 0.0025, 0.0075, 0.04, np.random.default_rng(1)), np.full(1500, 0.0025))
        > 0.0
    )
    assert np.abs(cloud).max(axis=1).min() > 0.0225
    result = check(make("million", tmp_path, 300))
    assert [str(finding) for finding in result.findings] == []
    assert len(result.magnets("inducible")) == 300 and len(result.contents.kinematic) == 1
    assert result.path.endswith("million_300.usdc")


def test_a_number_of_balls_only_where_there_is_one(tmp_path):
    with pytest.raises(InputError, match="balls: the scene alphabets has a fixed number of balls"):
        make("alphabets", tmp_path, 10)
    with pytest.raises(InputError, match="balls: must be positive"):
        make("million", tmp_path, 0)


@pytest.mark.parametrize(
    "author,parameters,body",
    [
        (balls_up.author, {"columns": 1, "rows": 1}, "/World/Balls/Ball_0002"),
        (falling_magnet.author, {"balls": 5}, "/World/Balls/Ball_00004"),
        (sakura_tree.author, {"balls": 5, "branches": 12}, "/World/Balls/Ball_00004"),
        pytest.param(
            alphabets.author, {"columns": 1, "rows": 1, "layers": 1}, "/World/Letters/A_000", marks=needs_outlines
        ),
    ],
)
def test_saturation_can_be_chosen(tmp_path, author, parameters, body):
    path = tmp_path / "scene.usdc"
    author(path, saturation=5e4, **parameters)
    assert open_stage(path).GetPrimAtPath(body).GetAttribute("warpmag:saturationMagnetization").Get() == 5e4


@needs_outlines
def test_other_letters(tmp_path):
    path = tmp_path / "scene.usdc"
    alphabets.author(path, columns=3, rows=2, layers=1, size=0.05, thickness=0.01)
    result = check(path)
    names = [magnet.rpartition("/")[2] for magnet in result.magnets("inducible")]
    assert names == ["A_000", "B_001", "C_002", "D_003", "E_004", "F_005"] and not result.findings


@pytest.mark.parametrize(
    "author,parameters,word",
    [
        (falling_magnet.author, {"balls": 0}, "balls"),
        (falling_magnet.author, {"drop": 0.0}, "drop"),
        (sakura_tree.author, {"spacing": 0.01}, "spacing"),
        (sakura_tree.author, {"bud_radius": 0.1}, "bud_radius"),
        (crystal_balls.author, {"rows": 4}, "bar_rows"),
        (crystal_balls.author, {"bar": 3}, "bar"),
        (crystal_balls.author, {"spacing": 0.01}, "spacing"),
        (crystal_balls.author, {"strength": "huge"}, "strength"),
        (alphabets.author, {"layers": 0}, "layers"),
        (million.author, {"spacing": 0.005}, "spacing"),
        (million.author, {"magnet": 1.5}, "magnet"),
    ],
)
def test_parameters_that_make_no_scene_are_refused(tmp_path, author, parameters, word):
    with pytest.raises(InputError, match=word):
        author(tmp_path / "scene.usdc", **parameters)
    assert not (tmp_path / "scene.usdc").exists()


def _imported(path):
    newton = pytest.importorskip("newton")
    builder = newton.ModelBuilder()
    return newton, builder, builder.add_usd(open_stage(path))


def _mass(radius, density=7870.0):
    return density * 4.0 / 3.0 * math.pi * radius**3


def test_newton_imports_the_falling_magnet(tmp_path):
    falling_magnet.author(tmp_path / "small.usdc", balls=61)
    newton, builder, result = _imported(tmp_path / "small.usdc")
    assert builder.body_count == 62 and builder.shape_count == 63
    magnet = result["path_body_map"]["/World/Magnet"]
    masses = np.array(builder.body_mass)
    assert masses[magnet] == pytest.approx(_mass(0.02, 7500.0), rel=1e-5)
    np.testing.assert_allclose(np.delete(masses, magnet), _mass(0.005), rtol=1e-5)
    np.testing.assert_allclose(builder.shape_material_mu, 0.4, rtol=1e-6)
    assert not any(flags & int(newton.BodyFlags.KINEMATIC) for flags in builder.body_flags)


def test_newton_imports_the_sakura_tree(tmp_path):
    sakura_tree.author(tmp_path / "small.usdc", balls=100)
    newton, builder, result = _imported(tmp_path / "small.usdc")
    assert builder.body_count == 101
    tree = result["path_body_map"]["/World/Tree"]
    assert builder.body_flags[tree] & int(newton.BodyFlags.KINEMATIC)
    types = np.array(builder.shape_type)[builder.body_shapes[tree]]
    stage = open_stage(tmp_path / "small.usdc")
    assert np.count_nonzero(types == newton.GeoType.SPHERE) == 110
    assert np.count_nonzero(types == newton.GeoType.CAPSULE) == len(types) - 110
    branch = stage.GetPrimAtPath("/World/Tree/Branch_0100")
    shape = result["path_shape_map"]["/World/Tree/Branch_0100"]
    frame = builder.shape_transform[shape]
    matrix = UsdGeom.Xformable(branch).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    np.testing.assert_allclose(np.array(frame.p), matrix.ExtractTranslation(), atol=1e-6)
    np.testing.assert_allclose(np.delete(np.array(builder.body_mass), tree), _mass(0.005), rtol=1e-5)
    np.testing.assert_allclose(builder.shape_material_mu, 0.4, rtol=1e-6)


def test_newton_imports_the_letters():
    newton, builder, result = _imported(bundled()["alphabets"])
    assert builder.body_count == 100
    assert np.linalg.norm(builder.gravity) == 0.0
    stage = open_stage(bundled()["alphabets"])
    center = result["path_shape_map"]["/World/Center"]
    boxes = [k for k in range(builder.shape_count) if builder.shape_type[k] == newton.GeoType.BOX]
    filtered = {frozenset(pair) for pair in builder.shape_collision_filter_pairs}
    assert all(frozenset((center, box)) in filtered for box in boxes)
    assert not builder.shape_flags[center] & newton.ShapeFlags.VISIBLE
    np.testing.assert_allclose(np.array(builder.shape_material_mu)[boxes], 0.4, rtol=1e-6)
    np.testing.assert_allclose(np.array(builder.shape_margin)[boxes], 0.03 * 0.005, rtol=1e-6)
    assert all(builder.shape_flags[k] & newton.ShapeFlags.COLLIDE_SHAPES for k in boxes)
    assert not any(builder.shape_flags[k] & newton.ShapeFlags.VISIBLE for k in boxes)
    first = result["path_body_map"]["/World/Letters/I_008"]
    assert builder.body_mass[first] == pytest.approx(7870.0 * (385.0 / 1493.0) * 0.02**2 * 0.005, rel=1e-5)
    shells = [k for k in range(builder.shape_count) if builder.shape_type[k] == newton.GeoType.MESH]
    assert len(shells) == 100 and stage.GetPrimAtPath("/World/Letters/I_008/Shell")


def test_newton_imports_the_crystal_balls():
    newton, builder, result = _imported(bundled()["crystal_balls"])
    assert builder.body_count == 179
    assert all(flags & int(newton.BodyFlags.KINEMATIC) for flags in builder.body_flags)
    bar = result["path_shape_map"]["/World/Magnet"]
    np.testing.assert_allclose(builder.shape_scale[bar], (0.0545, 0.016, 0.016), rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "balls"),
    [
        *((name, None) for name in SCENES if name != "sakura_tree"),
        ("sakura_tree", 300),
        pytest.param("sakura_tree", None, marks=pytest.mark.long),
    ],
)
def test_scenes_run(name, balls, tmp_path):
    """A few steps from the bundled stage: nothing overlaps at the start, all stays finite, induction converges."""
    pytest.importorskip("newton")
    from warpmag.engine.stepping.simulation import Simulation  # noqa: PLC0415 - the other tests do without the engine

    simulation = Simulation(make(name, tmp_path, balls) if balls else bundled()[name], device="cpu")
    assert simulation.statistics.overlapping == 0
    before = simulation.state.body_q.numpy().copy()
    for _ in range(2):
        simulation.step()
    after = simulation.state.body_q.numpy()
    assert np.isfinite(after).all() and np.isfinite(simulation.state.body_qd.numpy()).all()
    assert np.array_equal(before, after) == (name == "crystal_balls")
    moments = simulation.magnetics.shape_moments()
    assert np.isfinite(moments).all() and (np.linalg.norm(moments, axis=1) > 0.0).all()
    assert simulation.statistics.error <= 1e-3
    assert simulation.statistics.unconverged == 0
