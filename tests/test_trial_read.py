"""Stages on which USD's own reader crashes or hangs end in one line: a child process reads them first."""

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
from warpmag.usd.read import input_errors, trial_read

HEAD = "#usda 1.0\n"
NESTED = {
    "prims": 'def "x" {\n' * 100_000 + "}\n" * 100_000,
    "dictionaries": "(customLayerData = " + "{ dictionary a = " * 100_000 + "{}" + "}" * 100_000 + ")\n",
    "numbers": 'def "x" { float3 a = ' + "(" * 100_000 + ")" * 100_000 + "}\n",
}


def crate(path):
    """A small binary stage."""
    layer = Sdf.Layer.CreateNew(str(path))
    Sdf.CreatePrimInLayer(layer, "/World").specifier = Sdf.SpecifierDef
    layer.Save()
    return path


@pytest.mark.parametrize("case", NESTED)
def test_text_that_overflows_usd_s_stack_is_refused(tmp_path, case):
    path = tmp_path / "deep.usda"
    path.write_text(HEAD + NESTED[case])
    with pytest.raises(InputError, match="deep.usda: brackets are nested more than 5000 deep"):
        open_stage(path)


def test_usd_itself_crashes_on_nested_text(tmp_path):
    path = tmp_path / "deep.usda"
    path.write_text(HEAD + NESTED["dictionaries"])
    program = f"from pxr import Sdf\nSdf.Layer.OpenAsAnonymous({str(path)!r})"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, check=False).returncode < 0


def test_a_crash_in_a_sublayer_is_one_line(tmp_path):
    (tmp_path / "below.usda").write_text(HEAD + NESTED["dictionaries"])
    path = tmp_path / "stage.usda"
    path.write_text(HEAD + "(subLayers = [@./below.usda@])\n")
    with pytest.raises(InputError, match="stage.usda: USD's reader crashes on it .SIGSEGV.") as caught:
        open_stage(path)
    assert "\n" not in str(caught.value)


def test_moderately_nested_text_is_read(tmp_path):
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


def test_a_read_that_waits_forever_is_ended(tmp_path, monkeypatch):
    """A pipe without a writer."""
    pipe = tmp_path / "below.usdc"
    os.mkfifo(pipe)
    path = tmp_path / "stage.usda"
    # a variable of another layer: the name is known only after composition
    path.write_text(HEAD + '(expressionVariables = {string X = "below"}\nsubLayers = [@./between.usda@])\n')
    (tmp_path / "between.usda").write_text(HEAD + '(subLayers = [@`"./${X}.usdc"`@])\n')
    monkeypatch.setattr(trial_read, "_SECONDS", 1.0)
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


def test_a_read_that_computes_forever_is_ended(tmp_path, monkeypatch):
    """The limit is on CPU time, so that other load on the machine changes nothing."""
    path = crate(tmp_path / "stage.usdc")
    run = subprocess.run

    def busy(command, **options):
        assert int(command[-1]) == 30
        program = "import resource\nresource.setrlimit(resource.RLIMIT_CPU, (1, 2))\nwhile True: pass"
        return run([sys.executable, "-c", program], **options)

    monkeypatch.setattr(subprocess, "run", busy)
    with pytest.raises(InputError, match="stage.usdc: USD did not read it within 30 s"):
        open_stage(path)


def test_long_layers_of_a_run_get_more_time(tmp_path, monkeypatch):
    """The root of a run is short, and the cache that it names takes the time."""
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
    assert not trial_read.trial_read(root)
    assert limits == [50]


def test_a_long_complaint_is_cut(tmp_path):
    """A table of specs that claims 65,536 more, each of which USD reports."""
    content = bytearray(crate(path := tmp_path / "stage.usdc").read_bytes())
    entry = content.rindex(b"SPECS\0")
    content[int.from_bytes(content[entry + 16 : entry + 24], "little") + 2] = 1
    path.write_bytes(content)
    with pytest.raises(Tf.ErrorException) as caught:
        Sdf.Layer.OpenAsAnonymous(str(path))
    assert len(caught.value.args[0].commentary) > 1e6
    assert len(input_errors.first_line(caught.value)) <= 1000
    with pytest.raises(InputError, match=r"stage.usdc: not a USD file \(Corrupt asset"):
        open_stage(path)


def test_a_read_that_takes_all_memory_is_ended(tmp_path, monkeypatch):
    """USD reports a lack of memory as an error of its own kind; the parent must not try again."""
    program = "raise RuntimeError('Encountered: std::bad_alloc, while reading')"
    (tmp_path / "pxr").mkdir()
    (tmp_path / "pxr" / "__init__.py").write_text(program)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(InputError, match=r"stage.usdc: USD needs more than half of the memory to read it"):
        open_stage(crate(tmp_path / "stage.usdc"))


def test_a_line_of_a_very_long_text_takes_no_memory():
    text = "x" * 20_000_000
    tracemalloc.start()
    line = one_line(text)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert line == f"{'x' * 400} ... {'x' * 200}"
    assert most < 100_000  # bytes; a list of its characters would have 8 for each


@pytest.mark.parametrize(
    ("kind", "module", "name"),
    [
        (MemoryError, "opening", "freeze"),
        (RecursionError, "check", "complete_instances"),
        (OverflowError, "check", "validate"),
        (SystemError, "check", "ball_instancers"),
    ],
)
def test_every_failure_to_read_is_one_line_about_the_file(kind, module, name, tmp_path, monkeypatch, capsys):
    def fail(*_):
        raise kind("too much")

    path = crate(tmp_path / "stage.usdc")
    monkeypatch.setattr(sys.modules[f"warpmag.usd.read.{module}"], name, fail)
    assert cli.main(["check", str(path)]) == cli.BAD_INPUT
    assert capsys.readouterr().err == f"warpmag: {path}: USD cannot read it (too much)\n"


def test_missing_variant_sets_are_damage(tmp_path):
    """One byte of a stage with variants is zero, so that their set has no name; USD's validators crash on it."""
    path = Path(shutil.copy(Path(__file__).parent / "fuzz" / "lost_variants.usdc", tmp_path / "stage.usdc"))
    with pytest.raises(InputError, match=r"stage.usdc: damaged: /World/Earth names variants that do not exist"):
        open_stage(path)


def multiplied(path, levels):
    """A short text of ``10**levels`` prims and more: each has ten of the next kind."""
    inner = "".join(f'def "x{k}" (references = </{{}}>) {{{{}}}}\n' for k in range(10))
    kinds = [f'def "C{level}" {{\n{inner.format(*[f"C{level + 1}"] * 10)}}}\n' for level in range(levels)]
    path.write_text(HEAD + "".join(kinds) + f'def "C{levels}" {{}}\n')
    return path


def test_a_short_text_of_too_many_prims(tmp_path, monkeypatch):
    monkeypatch.setattr(trial_read, "MOST_PRIMS", 3_000)
    with pytest.raises(InputError, match="stage.usda: holds more than 3000 prims"):
        open_stage(multiplied(tmp_path / "stage.usda", 4))
    assert open_stage(multiplied(tmp_path / "fewer.usda", 3))


@pytest.mark.long
def test_a_short_text_of_millions_of_prims(tmp_path):
    message = "holds more than 500000 prims|did not read it within 30 s|reader crashes on it|half of the memory"
    with pytest.raises(InputError, match=message):
        open_stage(multiplied(tmp_path / "stage.usda", 7))


def test_text_that_is_not_utf8_is_refused(tmp_path):
    """USD prints an error of Python for such a token, and ignores the token."""
    path = crate(tmp_path / "stage.usdc")
    layer = Sdf.Layer.FindOrOpen(str(path))
    Sdf.AttributeSpec(layer.GetPrimAtPath("/World"), "kind", Sdf.ValueTypeNames.Token).default = "inducible"
    layer.Save()
    path.write_bytes(path.read_bytes().replace(b"inducible", b"inducibl\x94"))
    with pytest.raises(InputError, match=r"stage.usdc: damaged: text that is not UTF-8"):
        open_stage(path)


def test_offsets_of_layers_that_overflow_together(tmp_path, monkeypatch):
    """Each offset is finite, and USD never finishes to compute the time samples below both."""
    monkeypatch.setattr(trial_read, "_SECONDS", 1.0)
    arc = "(subLayers = [@{}@ (scale = 1e200)])\n"
    for name, below in (("one", "two"), ("two", "three")):
        (tmp_path / f"{name}.usda").write_text(HEAD + arc.format(f"{below}.usda"))
    (tmp_path / "three.usda").write_text(HEAD + 'def "x" {\n double a.timeSamples = { 0: 0, 24: 1 }\n}\n')
    with pytest.raises(InputError, match=r"one\.usda: USD did not read it within 1 s$"):
        open_stage(tmp_path / "one.usda")
