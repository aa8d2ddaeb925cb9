"""Reads a stage once in a process of its own, because USD's reader may take its process with it.

Text nested 100,000 deep overflows its stack; a binary file, one of 1,800 in which bytes were changed at random, made it
take all the memory there is for minutes; a short text whose prims refer to each other may stand for millions of prims.
A single text file without any of that is read at once: a process of its own costs a quarter of a second.

This file is also what that process runs, without importing anything of warpmag.
"""

import contextlib
import ctypes
import json
import os
import re
import signal
import subprocess
import sys
from itertools import accumulate, islice

DEEPEST_NESTING = 5_000
"""Brackets within brackets of a text. USD reads 10,000 on the stack of a main thread, and dies of 100,000."""
MOST_PRIMS = 500_000
"""Prims of a stage."""
FAILURES = (RuntimeError, UnicodeDecodeError, MemoryError, OverflowError, SystemError)
"""What USD raises over a stage; its own errors are of the first kind, and so is too deep a recursion."""
_LONGEST = 1_000
"""Characters that are kept of what USD says: of a damaged file that may be a gigabyte."""
_SECONDS, _BYTES_PER_SECOND = 30.0, 5e6
"""CPU time that a reading may take [s], and bytes, those of named files among them, for which a second more."""
_LOADED = 2
"""How many times that it may take on a machine that has other things to do."""
_FILLS = 165, 90
"""What new memory is filled with in a first and in a second reading. Of some damaged files USD unpacks less than it
then uses, and takes for the rest what happens to be in memory, which shows as a difference."""
_PERTURB = -6
"""glibc's M_PERTURB."""
_TWICE = 1 << 28
"""Bytes of a binary layer that is read twice; a longer one would take too much memory and time, as text."""
_CHANGING = re.compile(r" LZ4 error code: -?\d+")
"""What USD says of the same file differently each time."""
NOT_USD = "not a USD file"
_NOT_TEXT = "text that is not UTF-8"
_PRINTED = {
    b"posix_madvise": "damaged: its table of contents names bytes beyond its end",
    b"UnicodeDecodeError": f"damaged: {_NOT_TEXT}",
}
"""What USD prints of damaged files, without an error, and what it means."""
_TEXT = b"#usda"
_ARCS = (b"@", b"references", b"payload", b"inherits", b"specializes", b"prototypes")
"""What a text holds by which other files, or prims again, become part of it."""
_NAMED = re.compile(rb"@([^@\n\0]+)@")
_OPENING, _CLOSING = b"{[(", b"}])"
_OTHERS = bytes(set(range(256)) - {*_OPENING, *_CLOSING})


def first_reading(path: str | os.PathLike) -> str:
    """Return why USD cannot read a stage, if it dies of that or says so; empty where it can be read here.

    Args:
        path: A file that exists.
    """
    try:
        with open(path, "rb") as file:
            content = file.read(len(_TEXT))
            size = os.fstat(file.fileno()).st_size
            if content == _TEXT:
                content += file.read()
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    if content.startswith(_TEXT):
        if _depth(content) > DEEPEST_NESTING:
            return f"brackets are nested more than {DEEPEST_NESTING} deep"
        if not any(arc in content for arc in _ARCS):
            return ""
        size += _bytes_named(os.path.dirname(path), content)
    limit = round(_SECONDS + size / _BYTES_PER_SECOND)
    program = [sys.executable or "", "-S", "-E", __file__]
    command = [*program, json.dumps(sys.path), str(path), str(MOST_PRIMS), str(limit)]
    late = f"USD did not read it within {limit} s"
    try:
        done = subprocess.run(command, capture_output=True, check=False, timeout=_LOADED * limit)
    except subprocess.TimeoutExpired:
        return late
    except OSError:  # no interpreter to start: an application with Python inside
        return ""
    if done.returncode == -signal.SIGXCPU:
        return late
    if done.returncode < 0:
        return f"USD's reader dies of it ({signal.Signals(-done.returncode).name})"
    why = ""
    with contextlib.suppress(ValueError):
        why = str(json.loads(done.stdout))
    # what USD prints itself it would print again, past all that could keep it quiet
    printed = [meaning for words, meaning in _PRINTED.items() if words in done.stderr]
    return why or "".join(printed[:1])


def _bytes_named(folder: str, text: bytes) -> int:
    """Return how long the files are that a text names, such as the layers of a run."""
    names = {os.path.join(folder, os.fsdecode(name)) for name in _NAMED.findall(text)}
    return sum(os.path.getsize(name) for name in names if os.path.isfile(name))


def _depth(text: bytes) -> int:
    """Return how deep brackets lie in brackets, those in strings among them."""
    steps = (1 if one in _OPENING else -1 for one in text.translate(None, _OTHERS))
    return max(accumulate(steps), default=0)


def failure(error: Exception) -> str:
    """Return the first thing that an error raised by USD says, on one line."""
    if isinstance(error, UnicodeDecodeError):
        return _NOT_TEXT
    try:
        said = getattr(error.args[0], "commentary", error.args[0]) if error.args else ""
    except UnicodeDecodeError:  # it quotes the file
        return _NOT_TEXT
    except MemoryError:
        said = ""
    lines = str(said)[:_LONGEST].strip().splitlines()
    return _CHANGING.sub("", lines[0]) if lines else type(error).__name__


def _read(path: str, most: int) -> str:  # pragma: no cover - in the child, which has nothing of coverage's
    """Read a stage of so many prims at most, to the last value of its layers; return why that fails, or nothing."""
    from pxr import Ar, Sdf, Usd  # noqa: PLC0415 - only the child needs it

    _fill_memory(_FILLS[0])
    try:
        stage = Usd.Stage.Open(path)
        sound = all(1e-6 < layer.timeCodesPerSecond < 1e9 for layer in stage.GetUsedLayers())  # else they are refused
        prims = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate))
        for count, prim in enumerate(islice(prims, most + 1), 1):
            if count > most:
                return f"holds more than {most} prims"
            for attribute in prim.GetAuthoredAttributes():
                attribute.Get()
                if sound:
                    attribute.GetTimeSamples()  # which USD never finds where offsets of layers overflow
        for layer in stage.GetUsedLayers():
            if layer.GetFileFormat().formatId == "usda":  # all of a text is read at once
                continue
            if lost := _lost(layer):
                return f"damaged: {lost} names variants that are not there"
            if os.path.getsize(Ar.SplitPackageRelativePathOuter(layer.realPath)[0]) > _TWICE:
                Sdf.Layer.CreateAnonymous(".usda").TransferContent(layer)
            elif not _reads_alike(layer):
                return "damaged: USD takes some of its values from memory, not from the file"
    except Exception as error:  # of any kind: nothing but USD is at work here
        return f"{NOT_USD} ({failure(error)})"
    return ""


def _lost(layer) -> str:  # pragma: no cover - in the child, too
    """Return a prim that names a set of variants which the layer does not hold; USD's validators die of it."""
    paths = []
    layer.Traverse("/", paths.append)
    for path in paths:
        spec = layer.GetPrimAtPath(path) if path.IsPrimPath() else None
        if spec and None in spec.variantSets.values():
            return str(path)
    return ""


def _reads_alike(layer) -> bool:  # pragma: no cover - in the child, too
    """Whether a layer has the same content whatever new memory is filled with."""
    contents = set()
    for fill in _FILLS:
        _fill_memory(fill)
        contents.add(hash(type(layer).OpenAsAnonymous(layer.realPath).ExportToString()))
    return len(contents) == 1


def _fill_memory(byte: int) -> None:  # pragma: no cover - in the child, too
    """Have new memory filled with what a byte stands for, where glibc hands it out."""
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).mallopt(_PERTURB, byte)


def _limit(seconds: int) -> None:  # pragma: no cover - in the child, too
    """Let the process have half of the machine's memory at most, and so much CPU time [s], never more than it has."""
    import resource  # noqa: PLC0415 - not everywhere

    half = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    for kind, most in ((resource.RLIMIT_AS, half), (resource.RLIMIT_CORE, 0), (resource.RLIMIT_CPU, seconds)):
        soft, hard = resource.getrlimit(kind)
        resource.setrlimit(kind, (most if soft == resource.RLIM_INFINITY else min(soft, most), hard))


if __name__ == "__main__":  # pragma: no cover - in the child, too
    sys.path[:] = json.loads(sys.argv[1])
    with contextlib.suppress(ImportError, ValueError, OSError):
        _limit(int(sys.argv[4]))
    print(json.dumps(_read(sys.argv[2], int(sys.argv[3]))))
