"""A CPU that stands in for a GPU: the project sees a CUDA device, and its CUDA kernels run in Warp's fibers.

Warp and Newton see the CPU that it is, so that arrays, graphs and Newton's own kernels are those of a CPU. Kernels of
the project are compiled with ``cuda_on_cpu.h`` before their headers, and run block by block with a fiber a thread:
thousands of times slower than on a GPU, with the same branches, indices, shuffles and barriers. Clusters of blocks are
left out. The stand-in stays until the process ends.
"""

import os
import re
import sys
import threading
from contextlib import nullcontext
from pathlib import Path
from zlib import crc32

import warp as wp
from warp._src import context

TESTS = Path(__file__).resolve().parent
KERNELS = TESTS.parent / "kernels"
INSTRUCTIONS = {
    r'asm\("rsqrt\.approx\.ftz\.f32.*': "y = cuda_on_cpu::rsqrt_ftz(c);",
    r"const unsigned address = \(unsigned\)__cvta_generic_to_shared\(to\);": "char* const address = (char*)to;",
    r'asm volatile\("cp\.async\.cg.*': "cuda_on_cpu::begin_copy(address + i, (const char*)from + i);",
    r'asm volatile\("cp\.async\.wait_all;".*?\);': "cuda_on_cpu::end_copies();",
    r'asm\("mapa\.u64.*': "there = here;",
    r'asm volatile\("mov\.u64 %0, %globaltimer.*': "t = __builtin_readcyclecounter();",
}
"""Instructions of a GPU in the sources, as patterns, and what they do."""
LANE = "const cuda_on_cpu::Lane running(block_id, lane, dim->size - payload->block_first);"
"""What a thread begins with."""
SM_COUNT = 132
OTHERS = "warp", "newton", "mujoco_warp"
"""Packages that see the CPU that the device is."""


def without_instructions(source: str) -> str:
    """Source whose instructions of a GPU are what they do on a CPU."""
    for pattern, meaning in INSTRUCTIONS.items():
        source = re.sub(pattern, lambda _, meaning=meaning: meaning, source)
    left = re.sub(r'asm(?: volatile)?\(".*?cluster', "", source)  # clusters are left out
    assert "asm(" not in left and "asm volatile" not in left, "an instruction that the stand-in does not know"
    return source


def ours(kernel) -> bool:
    """Whether a kernel is the project's."""
    return kernel.func.__module__.partition(".")[0] not in OTHERS


def asked_by_warp() -> bool:
    """Whether Warp or Newton asks what the device is, not the project."""
    return sys._getframe(2).f_globals.get("__name__", "").partition(".")[0] in OTHERS


class Stream:
    """A stream or an event, of a device where everything is done at once."""

    def __init__(self, device=None, **_):
        self.device = device

    def wait_event(self, event):
        """Wait for nothing."""

    def record_event(self, event=None):
        """Return the event."""
        return event


def look_like_cuda(put=setattr, arch: int = 80):
    """Let the project see a CUDA device in the CPU.

    Args:
        put: Sets an attribute of an object, as ``setattr``.
        arch: Architecture of the device, from 90 on with clusters.
    """
    cpu = wp.get_device("cpu")
    put(cpu, "sm_count", SM_COUNT)
    put(cpu, "arch", arch)
    put(cpu, "pinned_allocator", cpu.default_allocator)
    put(context.Device, "is_cuda", property(lambda _: not asked_by_warp()))
    put(context.Device, "is_cpu", property(lambda _: asked_by_warp()))
    put(context.Device, "stream", property(Stream))
    put(wp, "synchronize_stream", lambda _: None)
    put(wp, "synchronize_event", lambda _: None)
    put(wp, "Stream", Stream)
    put(wp, "Event", Stream)
    put(wp, "get_stream", Stream)
    for name in ("ScopedStream", "ScopedAllocator"):
        put(wp, name, lambda *_, **__: nullcontext())
    launch_in_blocks(put)


def launch_in_blocks(put):
    """Let kernels of the project have blocks of threads, 256 unless they say other."""

    def wrapped(original):
        def launch(kernel, *args, **options):
            wp.config.enable_cpu_blocks = ours(kernel)
            if ours(kernel):
                options["block_dim"] = options.get("block_dim") or 256
            try:
                return original(kernel, *args, **options)
            finally:
                wp.config.enable_cpu_blocks = False

        return launch

    put(wp, "launch", wrapped(context.launch))
    put(wp, "launch_tiled", wrapped(context.launch_tiled))


def compile_as_cuda(folder: Path):
    """Compile kernels with blocks as CUDA's, with headers in a folder."""
    for header in KERNELS.rglob("*.h"):
        copy = folder / header.relative_to(KERNELS)
        copy.parent.mkdir(parents=True, exist_ok=True)
        part = copy.with_suffix(f".{os.getpid()}")  # for other processes to find it whole
        part.write_text(without_instructions(header.read_text()))
        part.replace(copy)
    words = (TESTS / "cuda_on_cpu.h").read_text()
    words = f"// {crc32(repr((INSTRUCTIONS, LANE)).encode())}\n{words}"  # what is compiled depends on these, too
    resolve, codegen = context.Module.resolve_options, context.ModuleBuilder.codegen

    def resolve_options(module, config, block_dim=None):
        options = resolve(module, config, block_dim)
        if options["block_dim"] > 1 and all(map(ours, module._get_live_kernels())):
            options["extra_cpu_preamble"] = words + options["extra_cpu_preamble"]
            options["extra_cpu_include_dirs"] = (str(folder),)
        return options

    def generated(builder, device):
        source = without_instructions(codegen(builder, device))
        if "namespace cuda_on_cpu" in source:
            source = source.replace("void* dim_ptr, size_t, int lane,", "void* dim_ptr, size_t block_id, int lane,")
            source = re.sub(r"(const size_t task_index = payload->block_first.*)", rf"\1\n    {LANE}", source)
        return source

    context.Module.resolve_options, context.ModuleBuilder.codegen = resolve_options, generated


def start():
    """Let the CPU stand in for a GPU."""
    wp.init()
    look_like_cuda()
    run, first = context.invoke_cpu_blocks, threading.Lock()

    def run_alone(*arguments):
        with first:  # shared memory is there once
            run(*arguments)

    context.invoke_cpu_blocks = run_alone
    compile_as_cuda(Path(wp.config.kernel_cache_dir) / "cuda_on_cpu")
