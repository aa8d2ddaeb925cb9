"""Kernels that call C++ headers, and the options under which Warp compiles them.

A header is named and included by its path from ``kernels/``, such as ``pairs/pair_law.h``. Its code is in namespace
``warpmag``. It may use ``Real``, the scalar type of the module, and the constants that the kernel sets.
"""

import linecache
import re
from pathlib import Path

import warp as wp

CHUNK = 16  # lanes of the widest vectors of a CPU; as in ``lanes.h``. Arrays of balls are padded to a multiple of it
LINE = 16  # numbers in a ball's cache line; as in ``lanes.h``. Transposing lines into vectors is faster than gathering
PASS_ARGUMENTS = {"first": int, "last": int, "threads": int, "team": wp.array2d[wp.uint64]}
"""Arguments of a kernel that makes passes ``first`` to ``last`` − 1 over balls, before the struct of its arrays.

A pass is written once for both devices. On a CPU it works on a vector of balls, and ``threads`` threads of the ``team``
share the balls. On a GPU a group of threads shares a ball.
"""
_FOLDER = Path(__file__).resolve().parents[1]
_INCLUDE = re.compile(r'^#include "(.+)"$', re.MULTILINE)


def native_kernel(call: str, header: str, arguments: dict, *, dtype, launch: dict | None = None, **constants):
    """Return a kernel in which each thread calls a C++ function.

    Args:
        call: Call of a function in namespace ``warpmag``, whose name the kernel gets. The call may use the kernel's
            arguments and ``thread``, the index of the thread.
        header: Path of the header from ``kernels/``.
        arguments: Warp types of the kernel's arguments, by name.
        dtype: Warp scalar type that ``Real`` is.
        launch: Options of ``wp.kernel``, such as ``launch_bounds``.
        constants: Integers and reals that the header uses, by their names there.
    """
    function, names = re.findall(r"\w+(?=[<(])", call)[0], ", ".join(arguments)
    source = f"def native(thread, {names}): ...\ndef {function}({names}):\n    native(wp.tid(), {names})\n"
    # Warp reads the source of a function from the line cache
    file = f"<native_kernel {function}({names})>"
    linecache.cache[file] = len(source), None, source.splitlines(keepends=True), file
    scope = {"__name__": __name__, "wp": wp}
    exec(compile(source, file, "exec"), scope)
    scope["native"].__annotations__, scope[function].__annotations__ = {"thread": int, **arguments}, arguments
    scope["native"] = wp.func_native(f"warpmag::{call};")(scope["native"])
    options = native_options(header, dtype=dtype, **constants)
    kernel = wp.kernel(module="unique", enable_backward=False, module_options=options, **launch or {})
    return kernel(scope[function])


def native_options(*headers: str, dtype, **constants: int | float) -> dict:
    """Module options of a kernel with ``module="unique"`` whose ``wp.func_native`` snippets call functions of headers.

    Arguments are as in :func:`native_kernel`.
    """
    real = "float" if dtype is wp.float32 else "double"
    values = [
        f"constexpr {'int' if isinstance(value, int) else 'Real'} {name} = {value!r};"
        for name, value in constants.items()
    ]
    # fused multiply-add in headers, as on a GPU, but not in Warp's code that follows
    lines = [
        "namespace warpmag {",
        f"using Real = {real};",
        *values,
        "}",
        "#if !defined(__CUDA_ARCH__)",
        "#pragma float_control(push)",
        "#pragma clang fp contract(fast)",
        "#endif",
        *(f'#include "{header}"' for header in headers),
        "#if !defined(__CUDA_ARCH__)",
        "#pragma float_control(pop)",
        "#endif",
    ]
    preamble = "\n".join(lines) + "\n"
    options = wp.ModuleBuildOptions(
        extra_cpu_include_dirs=[_FOLDER],
        extra_cuda_include_dirs=[_FOLDER],
        extra_cpu_preamble=preamble,
        extra_cuda_preamble=preamble,
        extra_build_dependencies=sorted(_closure(headers)),
    )
    # AVX-512 vectors at full width: clang uses half of it by default. The warning about passing vectors to code without
    # AVX-512 does not apply: there is no such code.
    flags = f"{wp.config.cpu_compiler_flags or '-march=native'} -mprefer-vector-width=512 -Wno-psabi"
    return {"extra_build_options": options, "cpu_compiler_flags": flags}


def _closure(headers) -> set[Path]:
    """Return the files of ``headers`` and of all headers that they include."""
    files: set[Path] = set()
    pending = [_FOLDER / header for header in headers]
    while pending:
        path = pending.pop()
        if path not in files:
            files.add(path)
            pending += [_FOLDER / name for name in _INCLUDE.findall(path.read_text(encoding="utf-8"))]
    return files
