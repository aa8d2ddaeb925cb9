"""Earlier spellings of arguments work, and warn with the present one."""

import newton
import numpy as np
import pytest

import warpmag
from warpmag.deprecation import keyword_arguments, renamed_arguments


@renamed_arguments(rate="fps")
def export(stage, *, fps=24.0):
    return stage, fps


def test_an_earlier_name_sets_the_present_argument():
    with pytest.warns(DeprecationWarning, match="export: rate is deprecated, use fps") as caught:
        assert export("stage", rate=30.0) == ("stage", 30.0)
    assert caught[0].filename == __file__
    assert export("stage", fps=12.0) == ("stage", 12.0)
    with pytest.raises(TypeError, match="fps and its earlier name rate"):
        export("stage", fps=12.0, rate=30.0)


@pytest.mark.parametrize("owner", ["Simulation", "Magnetics"])
def test_the_time_step_is_dt_as_in_newton(owner, device):
    """Both said ``step``, which in Newton is what a solver does."""
    builder = newton.ModelBuilder()
    warpmag.register_custom_attributes(builder)
    ball = builder.add_body()
    builder.add_shape_sphere(ball, radius=0.005)
    warpmag.add_inducible(builder, body=ball)
    given = builder if owner == "Simulation" else builder.finalize(device=device)
    options = {"device": device} if owner == "Simulation" else {}
    with pytest.warns(DeprecationWarning, match=f"{owner}: step is deprecated, use dt"):
        made = getattr(warpmag, owner)(given, step=2e-3, **options)
    assert owner == "Magnetics" or made.step_size == 2e-3
    with pytest.raises(warpmag.InputError, match="dt: must be positive"):
        getattr(warpmag, owner)(given, dt=-1.0, **options)


def test_field_maps_are_declared_as_coils_and_magnets_are():
    builder = newton.ModelBuilder()
    warpmag.register_custom_attributes(builder)
    values = np.zeros((2, 2, 2, 3))
    with pytest.warns(DeprecationWarning, match="add_field_map: name the origin, spacing, values") as caught:
        first = warpmag.add_field_map(builder, (-1.0, -1.0, -1.0), 2.0, values)
    assert caught[0].filename == __file__
    second = warpmag.add_field_map(builder, body=-1, origin=(-1.0, -1.0, -1.0), spacing=2.0, values=values)
    kept = builder.custom_attributes["warpmag:source"].values
    assert kept[first] == kept[second]


def test_other_positions_are_those_of_the_function():
    @keyword_arguments("body")
    def add(builder, *, body):
        return builder, body

    with pytest.warns(DeprecationWarning), pytest.raises(TypeError):
        add("builder", 4, 5)
