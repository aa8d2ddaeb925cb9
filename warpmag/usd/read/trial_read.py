"""Opens a stage in a child process first, because USD's reader can crash or hang on damaged or hostile files.

It also decides which files a stage may name: regular files only. A pipe or a device would make the reader wait forever.

The child costs a quarter of a second, and for long recordings a fraction of the time of an export. A single text file
without references is therefore read directly, and a stage is not tried again until one of its files changes. This file
is also the program of the child, which imports nothing of warpmag. Errors that USD raises are raised again when this
process reads the stage.
"""

import contextlib
import glob
import json
import os
import re
import signal
import stat
import subprocess
import sys
from collections.abc import Iterable
from itertools import accumulate, islice

MOST_PRIMS, DEEPEST_NESTING = 500_000, 5_000
"""Largest numbers of prims in a stage and of bracket levels in a text: USD reads 10,000 levels, crashes at 100,000."""
MOST_NAMES, MOST_CLIPS = 1_000, 100_000
"""Largest numbers of applied API schemas and of transform operations of a prim, and of value clips of a template."""
_SECONDS, _BYTES_PER_SECOND = 30.0, 5e6
"""Least limit of the child's CPU time [s], and bytes of the stage and its files that add a second to it."""
_ARCS = re.compile(rb"@|references|payload|inherits|specializes|prototypes|clips")
"""Words of a text layer that compose other files, or repeat prims."""
_SYSTEM_FOLDERS = ("/proc/", "/sys/")
"""Folders whose files the system makes up: some of them make a reader wait."""
_NO_BRACKETS = bytes(set(range(256)) - set(b"{[(}])"))
_NO_TABLE, _NO_TEXT = "its table of contents names bytes beyond its end", "text that is not UTF-8"
_WARNINGS = {b"posix_madvise": f"damaged: {_NO_TABLE}", b"UnicodeDecodeError": f"damaged: {_NO_TEXT}"}
"""Texts that USD prints on stderr in place of an error, and their meaning."""
_readable_stages: dict[str, dict[str, tuple | None]] = {}
"""Stages that can be read, with the files that each names and their stamps."""


def trial_read(path: str | os.PathLike) -> str:
    """Return the reason not to read a file in this process, empty if it can be read."""
    if reason := irregular_file(path):
        return reason
    stamps = _readable_stages.get(str(path))
    if stamps and stamps == _stamps(stamps):
        return ""
    reason, *files = _trial(path)
    if files and not reason:
        mark_readable(path, files)
    return reason


def mark_readable(path: str | os.PathLike, files: Iterable[str | os.PathLike]) -> None:
    """Spare a stage the trial read until one of its files changes."""
    _readable_stages[str(path)] = _stamps({str(path), *map(str, files)})


def _stamps(files: Iterable[str]) -> dict[str, tuple | None]:
    """Return values that change with the files, None for a missing file."""
    stamps: dict[str, tuple | None] = {}
    for file in files:
        try:
            status = os.stat(file)
            stamps[file] = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
        except (OSError, ValueError):
            stamps[file] = None
    return stamps


def _trial(path: str | os.PathLike) -> list[str]:
    """Return the reason not to read a file, empty if it can be read, and the files that the child found in it."""
    with open(path, "rb") as file:
        text = file.read() if file.peek(5).startswith(b"#usda") else b""
    nesting = accumulate(1 if bracket in b"{[(" else -1 for bracket in text.translate(None, _NO_BRACKETS))
    if max(nesting, default=0) > DEEPEST_NESTING:
        return [f"brackets are nested more than {DEEPEST_NESTING} deep"]
    if text and not _ARCS.search(text) and text.count(b"API:") <= MOST_NAMES:
        return [""]
    names = {os.path.join(os.path.dirname(path), os.fsdecode(name)) for name in re.findall(rb"@([^@\n\0]+)@", text)}
    size = os.path.getsize(path) + sum(os.path.getsize(name) for name in names if os.path.isfile(name))
    limit = round(_SECONDS + size / _BYTES_PER_SECOND)
    arguments = [json.dumps(sys.path), str(path), str(MOST_PRIMS), str(limit)]
    with contextlib.suppress(OSError):  # no interpreter, in an application that embeds Python
        command = [sys.executable or "", "-S", "-E", __file__, *arguments]
        with contextlib.suppress(subprocess.TimeoutExpired):  # twice the time, for a loaded machine
            options = {"stdin": subprocess.DEVNULL, "capture_output": True, "timeout": 2 * limit}
            child = subprocess.run(command, check=False, **options)
            if child.returncode >= 0:
                meanings = (meaning for words, meaning in _WARNINGS.items() if words in child.stderr)
                reason, *files = json.loads((child.stdout.splitlines() or [b'[""]'])[-1])
                return [reason or next(meanings, ""), *files]
            if child.returncode != -signal.SIGXCPU:
                return [f"USD's reader crashes on it ({signal.Signals(-child.returncode).name})"]
        return [f"USD did not read it within {limit} s"]
    return [""]


def irregular_file(path: str | os.PathLike) -> str:
    """Return the reason not to open a path: it is a device, a pipe or a file of the system. Empty otherwise."""
    try:
        real = os.path.realpath(path)
        mode = os.stat(path).st_mode  # of the path itself: the real path of a pipe without a name does not exist
    except PermissionError:  # links of /proc to other processes
        return f"{path} is not a regular file, or its links cannot be read"
    except OSError:  # USD reports missing files
        return ""
    regular = (stat.S_ISREG(mode) or stat.S_ISDIR(mode)) and not real.startswith(_SYSTEM_FOLDERS)
    return "" if regular else f"{path} is not a regular file"


def _excess(layer) -> str:
    """Return the reason not to compose a layer: USD would crash or take very long for a prim. Empty otherwise."""
    paths: list = []
    layer.Traverse("/", paths.append)
    binary = layer.GetFileFormat().formatId != "usda"
    prims = (layer.GetPrimAtPath(path) for path in paths if path.IsPrimPath() or path.IsPrimVariantSelectionPath())
    for spec in filter(None, prims):
        if binary and None in spec.variantSets.values():  # crashes USD's validators
            return f"damaged: {spec.path} names variants that do not exist"
        schemas = spec.GetInfo("apiSchemas").GetAddedOrExplicitItems() if spec.HasInfo("apiSchemas") else ()
        if len(schemas) > MOST_NAMES:
            return f"{spec.path} has {len(schemas)} applied API schemas, at most {MOST_NAMES}"
        clips = spec.GetInfo("clips") if spec.HasInfo("clips") else {}
        for clip_set in (values for values in clips.values() if isinstance(values, dict)):
            times = [clip_set.get(f"template{name}", 0.0) for name in ("StartTime", "EndTime", "Stride")]
            start, end, stride = (time if isinstance(time, float | int) else 0.0 for time in times)
            if stride and not abs(end - start) / abs(stride) <= MOST_CLIPS:
                return f"{spec.path} has a template of more than {MOST_CLIPS} clips"
    return ""


def _irregular_dependency(path: str, seen: set[str]) -> str:  # pragma: no cover - runs in the child
    """Return :func:`irregular_file` of the first file that a stage names in any layer, variant, clip or attribute.

    Add the names of all files to ``seen``.
    """
    from pxr import Ar, Sdf, UsdUtils  # noqa: PLC0415 - only the child needs it

    pending = [path]
    while pending:
        name = pending.pop()
        file = Ar.SplitPackageRelativePathOuter(name)[0]
        seen |= {name, file}
        if reason := irregular_file(file):
            return reason
        layer = Sdf.Layer.FindOrOpen(name) if Sdf.FileFormat.FindByExtension(name) else None
        if layer is None:
            continue
        if reason := _excess(layer):
            return reason
        named = {text for texts in UsdUtils.ExtractExternalReferences(name) for text in texts if text}
        anchored = {Sdf.ComputeAssetPathRelativeToLayer(layer, text) for text in named}
        # a template of clips names many files
        files = {file for text in anchored for file in (glob.glob(re.sub(r"#+", "*", text)) if "#" in text else [text])}
        pending += sorted(files - seen)
        seen |= files
    return ""


def _read_values(layer) -> None:  # pragma: no cover - runs in the child
    """Read all values of a layer, prim by prim, so that those of a long recording need little memory."""
    from pxr import Sdf  # noqa: PLC0415 - only the child needs it

    paths: list = []
    layer.Traverse("/", paths.append)
    copy = Sdf.Layer.CreateAnonymous(".usda")
    without_children = (lambda *_: True, lambda field, *_: field != "primChildren")
    Sdf.CopySpec(layer, "/", copy, "/", *without_children)
    for path in (path for path in paths if path.IsPrimPath()):
        has_children = bool(layer.GetPrimAtPath(path).nameChildren)
        Sdf.CopySpec(layer, path, copy, "/Trial", *without_children[: 2 * has_children])


def _read(path: str, most_prims: int, files: set[str]) -> str:  # pragma: no cover - runs in the child
    """Read a stage up to the last value of its layers; return the reason to reject it, or an empty text.

    Add the names of its files to ``files``.
    """
    from pxr import Usd, UsdUtils  # noqa: PLC0415 - only the child needs it

    if reason := _irregular_dependency(path, files):
        return reason
    stage = Usd.Stage.Open(path)
    files |= {layer.realPath for layer in stage.GetUsedLayers() if layer.realPath}
    rates_are_valid = all(1e-6 < layer.timeCodesPerSecond < 1e9 for layer in stage.GetUsedLayers())
    prims = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate))
    for count, prim in enumerate(islice(prims, most_prims + 1), 1):
        if count > most_prims:
            return f"holds more than {most_prims} prims"
        for attribute in prim.GetAuthoredAttributes() if rates_are_valid else ():
            attribute.Get()
            attribute.GetTimeSamples()  # never ends where offsets of layers overflow
    for layer in (layer for layer in stage.GetUsedLayers() if layer.GetFileFormat().formatId != "usda"):
        _read_values(layer)
    _, assets, _ = UsdUtils.ComputeAllDependencies(path)  # also evaluates expressions
    files |= set(assets)
    return next(filter(None, map(irregular_file, assets)), "")


if __name__ == "__main__":  # pragma: no cover - runs in the child
    import resource

    sys.path[:], half = json.loads(sys.argv[1]), os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    limits = {resource.RLIMIT_AS: half, resource.RLIMIT_CORE: 0, resource.RLIMIT_CPU: int(sys.argv[4])}
    for kind, (soft, hard) in {kind: resource.getrlimit(kind) for kind in limits}.items():
        resource.setrlimit(kind, (limits[kind] if soft < 0 else min(soft, limits[kind]), hard))
    files: set[str] = set()
    try:
        answer = [_read(sys.argv[2], int(sys.argv[3]), files), *sorted(files)]
    except Exception as error:  # the parent raises errors of other kinds again when it reads the stage
        needs_memory = isinstance(error, MemoryError) or "bad_alloc" in str(error)
        answer = ["USD needs more than half of the memory to read it" if needs_memory else ""]
    print(json.dumps(answer))
