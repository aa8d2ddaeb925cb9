"""Stages that USD's own reader dies of are read in a process of its own first."""

import os
import shutil
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import pytest
from pxr import Sdf, Tf

from warpmag import cli
from warpmag.errors import InputError, one_line
from warpmag.usd import open_stage
from warpmag.usd.read import first_reading

HEAD = "#usda 1.0\n"
NESTED = {
    "prims": 'def "x" {\n' * 100_000 + "}\n" * 100_000,
    "dictionaries": "(customLayerData = " + "{ dictionary a = " * 100_000 + "{}" + "}" * 100_000 + ")\n",
    "numbers": 'def "x" { float3 a = ' + "(" * 100_000 + ")" * 100_000 + "}\n",
}


def crate(path):
    """A small binary stage, and a longer one that it takes some of its content from."""
    layer = Sdf.Layer.CreateNew(str(path))
    Sdf.CreatePrimInLayer(layer, "/World").specifier = Sdf.SpecifierDef
    layer.Save()
    return path


def numbers(path):
    """A binary stage with 1,000 numbers, which USD packs."""
    layer = Sdf.Layer.FindOrOpen(str(crate(path)))
    attribute = Sdf.AttributeSpec(layer.GetPrimAtPath("/World"), "numbers", Sdf.ValueTypeNames.IntArray)
    attribute.default = range(0, 3000, 3)
    layer.Save()
    return path


@pytest.mark.parametrize("case", NESTED)
def test_what_overflows_the_stack_of_usd_is_refused(tmp_path, case):
    path = tmp_path / "deep.usda"
    path.write_text(HEAD + NESTED[case])
    with pytest.raises(InputError, match="deep.usda: brackets are nested more than 5000 deep"):
        open_stage(path)


def test_usd_dies_of_it_otherwise(tmp_path):
    path = tmp_path / "deep.usda"
    path.write_text(HEAD + NESTED["dictionaries"])
    program = f"from pxr import Sdf\nSdf.Layer.OpenAsAnonymous({str(path)!r})"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, check=False).returncode < 0


def test_what_dies_in_a_layer_below_is_one_line(tmp_path):
    (tmp_path / "below.usda").write_text(HEAD + NESTED["dictionaries"])
    path = tmp_path / "stage.usda"
    path.write_text(HEAD + "(subLayers = [@./below.usda@])\n")
    with pytest.raises(InputError, match="stage.usda: USD's reader dies of it .SIGSEGV.") as caught:
        open_stage(path)
    assert "\n" not in str(caught.value)


def test_a_nested_text_is_read(tmp_path):
    path = tmp_path / "stage.usda"
    path.write_text(HEAD + 'def "x" {\n' * 1000 + "}\n" * 1000)
    stage = open_stage(path)
    assert sum(1 for _ in stage.TraverseAll()) == 1000


def test_a_binary_stage_is_read(tmp_path):
    assert open_stage(crate(tmp_path / "stage.usdc")).GetPrimAtPath("/World")


@pytest.mark.parametrize("name", ["stage.usdc", "stage.usd", "stage.usdz"])
def test_a_damaged_binary_stage_is_one_line(tmp_path, capfd, name):
    content = crate(tmp_path / "whole.usdc").read_bytes()
    path = tmp_path / name
    path.write_bytes(content[: len(content) * 2 // 3])
    with pytest.raises(InputError, match=f"{name}: not a USD file") as caught:
        open_stage(path)
    assert "\n" not in str(caught.value) and capfd.readouterr().err == ""


def test_a_reader_that_does_not_end(tmp_path, monkeypatch):
    """A pipe that nobody writes to, as a file that takes for ever."""
    endless = tmp_path / "below.usdc"
    os.mkfifo(endless)
    path = tmp_path / "stage.usda"
    path.write_text(HEAD + "(subLayers = [@./below.usdc@])\n")
    monkeypatch.setattr(first_reading, "_SECONDS", 1.0)
    began = time.monotonic()
    with pytest.raises(InputError, match="stage.usda: USD did not read it within 1 s"):
        open_stage(path)
    assert time.monotonic() - began < 30.0


def test_without_an_interpreter_it_is_read_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "nothing"))
    assert open_stage(crate(tmp_path / "stage.usdc")).GetPrimAtPath("/World")


def test_text_that_is_no_text(tmp_path):
    path = tmp_path / "stage.usda"
    path.write_bytes(HEAD.encode() + b'def "\xff\xfe" {}\n')
    with pytest.raises(InputError, match="stage.usda: not a USD file"):
        open_stage(path)


def test_a_table_of_contents_beyond_the_end_is_damage(tmp_path, capfd):
    path = crate(tmp_path / "stage.usdc")
    data = bytearray(path.read_bytes())
    data[-8:] = (1 << 62).to_bytes(8, "little")  # size of the last section
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"stage.usdc: damaged: its table of contents names bytes beyond its end"):
        open_stage(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("name", ["stage.usdc", "stage.usd"])
def test_values_that_the_file_does_not_hold_are_damage(tmp_path, name):
    """Of 1,000 numbers the block that holds them unpacks to the first bytes; USD takes the others from its memory."""
    path, content = tmp_path / name, bytearray(numbers(tmp_path / "whole.usdc").read_bytes())
    place = content.index((1000).to_bytes(8, "little")) + 8  # where the block's length stands
    block = bytes([0, 0x40]) + (3).to_bytes(4, "little")  # one piece; four bytes as they are
    content[place : place + 8 + len(block)] = len(block).to_bytes(8, "little") + block
    path.write_bytes(content)
    for _ in range(2):
        with pytest.raises(InputError, match=f"{name}: damaged: USD takes some of its values from memory"):
            open_stage(path)


def test_packed_values_are_read(tmp_path):
    stage = open_stage(numbers(tmp_path / "stage.usdc"))
    assert list(stage.GetAttributeAtPath("/World.numbers").Get()) == list(range(0, 3000, 3))


def test_a_reader_that_computes_without_end(tmp_path, monkeypatch):
    """The process gets a limit of CPU time, so that a machine with other things to do changes nothing."""
    path = crate(tmp_path / "stage.usdc")
    run = subprocess.run

    def busy(command, **options):
        assert int(command[-1]) == 30
        program = f"import signal, runpy; reading = runpy.run_path({first_reading.__file__!r}); reading['_limit'](1)"
        return run([sys.executable, "-c", f"{program}\nwhile True: pass"], **options)

    monkeypatch.setattr(subprocess, "run", busy)
    with pytest.raises(InputError, match="stage.usdc: USD did not read it within 30 s"):
        open_stage(path)


def test_long_layers_of_a_run_have_their_time(tmp_path, monkeypatch):
    """The root of a run is short, and the cache that it names is what takes time to read."""
    crate(tmp_path / "long.usdc")
    with open(tmp_path / "long.usdc", "ab") as file:
        file.truncate(100_000_000)
    root = tmp_path / "root.usda"
    root.write_text(HEAD + "(subLayers = [@./long.usdc@, @./long.usdc@, @./none.usdc@])\n")
    limits, run = [], subprocess.run

    def noted(command, **options):
        limits.append(int(command[-1]))
        return run(command, **options)

    monkeypatch.setattr(subprocess, "run", noted)
    assert not first_reading.first_reading(root)
    assert limits == [50]


def many_specs(path):
    """A binary stage whose table of specs says to have 65,536 more, of each of which USD then complains."""
    content = bytearray(crate(path).read_bytes())
    entry = content.rindex(b"SPECS\0")
    place = int.from_bytes(content[entry + 16 : entry + 24], "little")
    content[place + 2] = 1
    path.write_bytes(content)
    return path


def test_a_long_complaint_is_cut_before_it_goes_anywhere(tmp_path):
    """With another byte changed it would be 640 MB, of which a line made character by character takes 5 GB."""
    path = many_specs(tmp_path / "stage.usdc")
    with pytest.raises(Tf.ErrorException) as caught:
        Sdf.Layer.OpenAsAnonymous(str(path))
    assert len(caught.value.args[0].commentary) > 1e6
    assert len(first_reading.failure(caught.value)) <= 1000
    assert 0 < len(first_reading.first_reading(path)) < 1100
    with pytest.raises(InputError, match=r"stage.usdc: not a USD file \(Corrupt asset"):
        open_stage(path)


def test_a_line_of_a_very_long_text_takes_no_memory():
    text = "x" * 20_000_000
    tracemalloc.start()
    line = one_line(text)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert line == f"{'x' * 400} ... {'x' * 200}"
    assert most < 100_000  # bytes; a list of its characters would have 8 for each


def test_the_process_gets_no_more_memory_than_there_is_here(tmp_path):
    """Or it would read what cannot be read here."""
    program = (
        "import resource, runpy; resource.setrlimit(resource.RLIMIT_AS, (1 << 31, 1 << 32)); "
        f"reading = runpy.run_path({first_reading.__file__!r}); reading['_limit'](7); "
        "print(*(resource.getrlimit(getattr(resource, f'RLIMIT_{name}'))[0] for name in ('AS', 'CORE', 'CPU')))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(1 << 31), "0", "7"]


@pytest.mark.parametrize(
    ("kind", "file", "name"),
    [
        (MemoryError, "reader", "hold"),
        (RecursionError, "check", "complete_instances"),
        (OverflowError, "check", "validate"),
        (SystemError, "check", "swarms_of"),
    ],
)
def test_whatever_reading_ends_with_is_one_line_about_the_file(kind, file, name, tmp_path, monkeypatch, capsys):
    def fail(*_):
        raise kind("too much")

    path = crate(tmp_path / "stage.usdc")
    monkeypatch.setattr(sys.modules[f"warpmag.usd.{file}"], name, fail)
    assert cli.main(["check", str(path)]) == cli.BAD_INPUT
    assert capsys.readouterr().err == f"warpmag: {path}: USD cannot read it (too much)\n"


def test_a_name_of_variants_that_are_not_there_is_damage(tmp_path):
    """One byte of a stage with variants is zero, so that their set has no name; USD's validators die of it."""
    path = Path(shutil.copy(Path(__file__).parent / "fuzz" / "lost_variants.usdc", tmp_path / "stage.usdc"))
    with pytest.raises(InputError, match=r"stage.usdc: damaged: /World/Earth names variants that are not there"):
        open_stage(path)


def multiplied(path, levels):
    """A short text of ``10**levels`` prims and more: each has ten of the next kind."""
    inner = "".join(f'def "x{k}" (references = </{{}}>) {{{{}}}}\n' for k in range(10))
    kinds = [f'def "C{level}" {{\n{inner.format(*[f"C{level + 1}"] * 10)}}}\n' for level in range(levels)]
    path.write_text(HEAD + "".join(kinds) + f'def "C{levels}" {{}}\n')
    return path


def test_a_short_text_of_too_many_prims(tmp_path, monkeypatch):
    monkeypatch.setattr(first_reading, "MOST_PRIMS", 3_000)
    with pytest.raises(InputError, match="stage.usda: holds more than 3000 prims"):
        open_stage(multiplied(tmp_path / "stage.usda", 4))
    assert open_stage(multiplied(tmp_path / "fewer.usda", 3))


@pytest.mark.long
def test_a_short_text_of_millions_of_prims(tmp_path):
    with pytest.raises(InputError, match="holds more than 500000 prims|did not read it within 30 s|reader dies of it"):
        open_stage(multiplied(tmp_path / "stage.usda", 7))


def test_text_that_is_not_utf8_is_refused(tmp_path):
    """USD prints an error of Python's for such a token, and takes it as if it were not there."""
    path = crate(tmp_path / "stage.usdc")
    layer = Sdf.Layer.FindOrOpen(str(path))
    Sdf.AttributeSpec(layer.GetPrimAtPath("/World"), "kind", Sdf.ValueTypeNames.Token).default = "inducible"
    layer.Save()
    path.write_bytes(path.read_bytes().replace(b"inducible", b"inducibl\x94"))
    with pytest.raises(InputError, match=r"stage.usdc: damaged: text that is not UTF-8"):
        open_stage(path)


def test_offsets_of_layers_that_overflow_together(tmp_path, monkeypatch):
    """Each is a number, and USD never ends to look for the times of what both are of."""
    monkeypatch.setattr(first_reading, "_SECONDS", 1.0)
    arc = "(subLayers = [@{}@ (scale = 1e200)])\n"
    for name, below in (("one", "two"), ("two", "three")):
        (tmp_path / f"{name}.usda").write_text(HEAD + arc.format(f"{below}.usda"))
    (tmp_path / "three.usda").write_text(HEAD + 'def "x" {\n double a.timeSamples = { 0: 0, 24: 1 }\n}\n')
    with pytest.raises(InputError, match=r"one\.usda: USD did not read it within 1 s$"):
        open_stage(tmp_path / "one.usda")
