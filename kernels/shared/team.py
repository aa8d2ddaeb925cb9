"""Threads of a CPU that help with the work of a launch.

Warp launches serially on a CPU, and a launch may sit inside a graph, where Python's threads cannot help. So native code
shares its work with threads of the process's own library. They are started once, since to start one takes longer than
many a launch. One that has helped looks for more to do for a while, as launches follow each other, and then sleeps.

A member of the team is some memory that all launches share: its state, what it is to do, and what it sleeps with. A
launch claims members that have nothing to do, and takes back what they have not begun when it is done itself. So it
never waits for a thread that does not come, and several that run at once share the members.
"""

import atexit
import os
import time
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.shared.native import native_options

MOST_THREADS = 64
"""Threads that may work on one launch, and shares that its work may be cut into."""
MOMENTS_PER_THREAD = 2500
"""Moments that make another thread worth waking for a pass over them and their neighbours: 0.1 to 0.2 ms."""
_STATE, _WORDS = 0, 24
_GONE, _ASLEEP = 0, 2
"""Place of a member's state among its words, how many these are, and two of its values; as in ``team.h``."""

_LIBRARY = """
#if defined(__APPLE__)
    #define SYMBOL(name) "_" name
#else
    #define SYMBOL(name) name
#endif
    typedef unsigned long long Word;
    typedef void* (*Start)(void*);
    extern int start_thread(unsigned long*, const void*, Start, void*) __asm__(SYMBOL("pthread_create"));
    extern int detach_thread(unsigned long) __asm__(SYMBOL("pthread_detach"));
    extern int yield_thread() __asm__(SYMBOL("sched_yield"));
    extern int make_lock(void*, const void*) __asm__(SYMBOL("pthread_mutex_init"));
    extern int lock(void*) __asm__(SYMBOL("pthread_mutex_lock"));
    extern int unlock(void*) __asm__(SYMBOL("pthread_mutex_unlock"));
    extern int make_bell(void*, const void*) __asm__(SYMBOL("pthread_cond_init"));
    extern int sleep(void*, void*) __asm__(SYMBOL("pthread_cond_wait"));
    extern int ring(void*) __asm__(SYMBOL("pthread_cond_signal"));
    #undef SYMBOL
    static constexpr auto change = [](Word* member, Word from, Word to) -> bool {
        return __atomic_compare_exchange_n(member + 0, &from, to, false, __ATOMIC_ACQ_REL, __ATOMIC_RELAXED);
    };
    static constexpr auto state_of = [](Word* member) -> Word {
        return __atomic_load_n(member + 0, __ATOMIC_ACQUIRE);
    };
    static constexpr auto set = [](Word* member, Word state) {
        __atomic_store_n(member + 0, state, __ATOMIC_RELEASE);
    };
"""

TOGETHER = f"""
    // together(team, threads, work) calls work(member) on as many threads, member 0 being the caller, and returns when
    // all of those that began have returned; one that cannot be had, or is late, leaves its part to the others
#if defined(_WIN32)
    auto together = [](unsigned long long*, int, auto& work) {{ work(0); }};
    auto yield_thread = [] {{}};
#else
    {_LIBRARY}
    auto together = [](Word* team, int threads, auto& work) {{
        typedef decltype(&work) Work;
        auto call = [](Word job, int number) {{ (*(Work)job)(number); }};
        Word* claimed[{MOST_THREADS}];
        int count = 0;
        for (int m = 0; m < {MOST_THREADS} && count < threads - 1; ++m) {{
            Word* const member = team + {_WORDS} * m;
            if (state_of(member) == 0) break;
            const bool asleep = change(member, 2, 3);
            if (!asleep && !change(member, 1, 3)) continue;
            claimed[count++] = member;
            member[1] = (Word)(void (*)(Word, int))call;
            member[2] = (Word)&work;
            member[3] = count;
            if (asleep) lock(member + 8);
            set(member, 4);
            if (!asleep) continue;
            unlock(member + 8);
            ring(member + 16);
        }}
        work(0);
        // to sleep until a thread has ended would take longer than to wait for it to say so
        for (int t = 0; t < count; ++t)
            while (!change(claimed[t], 4, 1) && state_of(claimed[t]) == 5) yield_thread();
    }};
#endif
"""
"""Text that defines ``together``, for native functions."""


@wp.func_native("warpmag::start_members(count, team.data);")
def _start(count: int, team: wp.array2d[wp.uint64]): ...


@wp.kernel(module="unique", enable_backward=False, module_options=native_options("shared/team.h", dtype=wp.float32))
def _start_members(
    # inputs:
    count: int,
    # outputs:
    team: wp.array2d[wp.uint64],
):
    _start(count, team)


def wide_registers() -> dict:
    """Options of a module with native vectors: registers as wide as there are; clang stops at half of AVX-512."""
    return {"cpu_compiler_flags": f"{wp.config.cpu_compiler_flags or '-march=native'} -mprefer-vector-width=512"}


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads_for(count: int, each: int) -> int:
    """Threads that share ``count`` pieces of work, ``each`` of which make another one worth waking."""
    return max(1, min(int(count) // each, cores(), MOST_THREADS))


@cache
def team() -> wp.array:
    """The members' memory, one for the process; it is what ``together`` takes."""
    members = wp.zeros((MOST_THREADS, _WORDS), dtype=wp.uint64, device="cpu")
    wp.launch(_start_members, dim=1, inputs=[min(cores(), MOST_THREADS) - 1], outputs=[members], device="cpu")
    atexit.register(_wait_until_asleep, members.numpy())
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=lambda: _forget(members.numpy()))
    return members


def _wait_until_asleep(members: np.ndarray) -> None:
    """Wait for members that look for work: the code that they run goes when the process ends."""
    for _ in range(100):
        if np.isin(members[:, _STATE], (_GONE, _ASLEEP)).all():
            return
        time.sleep(1e-3)


def _forget(members: np.ndarray) -> None:
    """Do without the members, which a process that was forked has not."""
    members[:] = _GONE
    team.cache_clear()
