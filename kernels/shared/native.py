"""C++ headers of this package beside kernels: the options under which Warp compiles them into a kernel's module.

A header is found by its path from ``kernels/``, such as ``pairs/pair_law.h``, and includes others by theirs. It may use
``Real``, the scalar type of the module, and the constants that its launcher passes; all of it is in namespace
``warpmag``. What a kernel calls of it stands in a ``wp.func_native`` of one line.
"""

import re
from pathlib import Path

import warp as wp

_FOLDER = Path(__file__).resolve().parents[1]
_INCLUDE = re.compile(r'^#include "(.+)"$', re.MULTILINE)


def native_options(*headers: str, dtype, **constants: int | float) -> dict:
    """Module options of a kernel with ``module="unique"`` whose snippets call functions of ``headers``.

    Args:
        headers: Paths from ``kernels/``.
        dtype: Warp scalar type that ``Real`` is.
        constants: Integers and reals that the headers use, by their names there.
    """
    real = "float" if dtype is wp.float32 else "double"
    values = [
        f"constexpr {'int' if isinstance(value, int) else 'Real'} {name} = {value!r};"
        for name, value in constants.items()
    ]
    # products and sums of a header may be fused, as those of a GPU are; Warp's own code that follows stays as it was
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
    # vectors as wide as there are, where clang stops at half of AVX-512; and no word on how wider ones would be handed
    # to code that was compiled without them: there is none
    flags = f"{wp.config.cpu_compiler_flags or '-march=native'} -mprefer-vector-width=512 -Wno-psabi"
    return {"extra_build_options": options, "cpu_compiler_flags": flags}


def _closure(headers) -> set[Path]:
    """Files of ``headers`` and of all that they include."""
    found: set[Path] = set()
    wanted = [_FOLDER / header for header in headers]
    while wanted:
        path = wanted.pop()
        if path not in found:
            found.add(path)
            wanted += [_FOLDER / name for name in _INCLUDE.findall(path.read_text(encoding="utf-8"))]
    return found
