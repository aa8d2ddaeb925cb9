"""Files that keep sampled shapes between processes: hits, versions, damage, folders that cannot be written."""

import gc
import logging
import warnings

import newton
import numpy as np
import pytest

import warpmag
from warpmag.engine.magnets import grouping, magnet_system, sampling
from warpmag.errors import InputError
from warpmag.shapes import polyhedra, shape_cache
from warpmag.shapes.shape_cache import ShapeCache


def counted(values):
    """A function that returns the next of ``values``, and the list of its calls."""
    calls = []

    def compute():
        calls.append(None)
        return values[len(calls) - 1]

    return compute, calls


def test_a_value_is_computed_once(tmp_path, caplog):
    compute, calls = counted([{"a": np.arange(3)}])
    with caplog.at_level(logging.INFO, "warpmag"):
        for key in ((1, "a", np.ones(2)), (1, "a", np.ones(2))):
            value = ShapeCache(tmp_path / "new").get("shape", key, compute)
            np.testing.assert_array_equal(value["a"], [0, 1, 2])
    assert len(calls) == 1
    assert [message.split()[1] for message in caplog.messages] == ["computed", "read"]


@pytest.mark.parametrize("other", [(2, b"ab"), (1, "ab"), (1, b"a", b"b"), (1.0, b"ab"), (1, b"ab", np.ones(1))])
def test_other_keys_have_other_values(tmp_path, other):
    shapes = ShapeCache(tmp_path)
    assert shapes.get("", (1, b"ab"), lambda: "first") == "first"
    assert shapes.get("", other, lambda: "second") == "second"


def test_the_list_of_files_is_closed_if_another_process_has_deleted_one(tmp_path):
    (tmp_path / "deleted").symlink_to("nowhere")  # listed, without a status
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ResourceWarning)
        assert ShapeCache(tmp_path).get("", (), lambda: 1) == 1
        gc.collect()
    assert not caught


def test_another_version_of_the_code_computes_again(tmp_path, monkeypatch):
    shapes = ShapeCache(tmp_path)
    assert shapes.get("", (), lambda: 1) == 1
    monkeypatch.setattr(shape_cache, "_version", lambda: "another")
    assert shapes.get("", (), lambda: 2) == 2


@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: data[:-1], lambda data: data[:40] + bytes(1)])
def test_damaged_files_are_replaced(tmp_path, caplog, damage):
    shapes = ShapeCache(tmp_path)
    shapes.get("", (), lambda: "a value")
    (file,) = tmp_path.iterdir()
    file.write_bytes(damage(file.read_bytes()))
    with caplog.at_level(logging.INFO, "warpmag"):
        assert shapes.get("", (), lambda: "computed again") == "computed again"
    assert "damaged" in caplog.text
    assert shapes.get("", (), lambda: "not called") == "computed again"


def test_folders_that_cannot_be_written_cost_only_time(tmp_path, caplog):
    (tmp_path / "file").write_text("")
    compute, calls = counted([1, 2])
    with caplog.at_level(logging.INFO, "warpmag"):
        results = [ShapeCache(tmp_path / "file").get("", (), compute) for _ in range(2)]
    assert results == [1, 2] and len(calls) == 2
    assert "cannot be written" in caplog.text


def test_errors_are_raised_and_nothing_is_kept(tmp_path):
    def fail():
        raise InputError("too thin")

    with pytest.raises(InputError, match="too thin"):
        ShapeCache(tmp_path).get("", (), fail)
    assert not list(tmp_path.iterdir())


def test_the_oldest_files_are_deleted(tmp_path, monkeypatch):
    monkeypatch.setattr(shape_cache, "MOST_BYTES", 2500)
    shapes = ShapeCache(tmp_path)
    for key in range(4):
        shapes.get("", (key,), lambda: bytes(1000))
    assert len(list(tmp_path.iterdir())) == 2


def test_a_second_model_reads_its_shapes(tmp_path, monkeypatch):
    """Bitwise the moments and tensors of the first one, without sampling."""
    monkeypatch.setattr(sampling, "shape_cache", lambda: ShapeCache(tmp_path))
    lattices = []
    for _ in range(2):
        builder = newton.ModelBuilder()
        warpmag.register_custom_attributes(builder)
        for radius in (0.004, 0.005):
            body = builder.add_body()
            builder.add_shape_cylinder(body, radius=radius, half_height=0.001)
            warpmag.add_inducible(builder, body=body, moment_spacing=0.002)
        magnets, _ = grouping.find_magnets(builder.finalize(device="cpu"))
        lattices.append([magnet.lattice for magnet in magnets])
        monkeypatch.setattr(sampling.ShapeSampler, "_fill", None)
    for computed, read in zip(*lattices, strict=True):
        np.testing.assert_array_equal(computed.positions, read.positions)
        np.testing.assert_array_equal(computed.coupling.tensor, read.coupling.tensor)
        assert computed is not read


def test_a_second_model_reads_the_table_of_a_cylinder_over_iron(tmp_path, monkeypatch):
    monkeypatch.setattr(magnet_system, "shape_cache", lambda: ShapeCache(tmp_path))
    builder = newton.ModelBuilder()
    warpmag.register_custom_attributes(builder)
    plate, disc = builder.add_body(), builder.add_body()
    builder.add_shape_box(plate, hx=0.01, hy=0.01, hz=0.002)
    warpmag.add_inducible(builder, body=plate, moment_spacing=0.004)
    builder.add_shape_cylinder(disc, radius=0.0049, half_height=0.0021)
    warpmag.add_permanent(builder, body=disc, magnetization=(0.0, 0.0, 1e6))
    model, tables = builder.finalize(device="cpu"), []
    for _ in range(2):
        system = warpmag.Magnetics(model).system
        tables.append(system.source_interaction.arrays.cells.cylinders.numpy())
        monkeypatch.setattr(polyhedra, "potential_table", None)
    np.testing.assert_array_equal(*tables)
    assert len(list(tmp_path.iterdir())) == 1 and len(tables[0]) > 1000
