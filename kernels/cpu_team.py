"""Threads of a CPU that help with the work of a launch.

Warp launches serially on a CPU, and a launch may sit inside a graph, where Python's threads cannot help. So native code
starts threads of the process's own library. To wake a core takes as long as many a launch: a thread that has helped
therefore stays for a while, at the disposal of whatever is launched next, and leaves if nothing is.

A member of the team is a cache line of memory that all launches share: its state, and what it is to do. A launch claims
members that wait, or starts a thread for them, and takes back what they have not begun when it is done itself; so it
never waits for a thread that does not come, and several that run at once share the members.
"""

import atexit
import os
import time
from functools import cache

import numpy as np
import warp as wp

VECTORS = True
"""Whether a CPU makes passes over neighbours in vectors and by threads; else they are plain Warp, as on a GPU."""
MOST_THREADS = 64
"""Threads that may work on one launch, and shares that its work may be cut into."""
_GONE, _WAITING, _CLAIMED, _POSTED, _WORKING = range(5)
_STATE, _CALL, _JOB, _NUMBER, _WORDS = 0, 1, 2, 3, 8
_PATIENCE = 4000
"""Times that a member looks for work before it leaves, about 1 ms; each time others may have its core instead."""

TOGETHER = f"""
    // together(team, threads, work) calls work(member) on as many threads, member 0 being the caller, and returns when
    // all of those that began have returned; one that cannot be had, or is late, leaves its part to the others
#if defined(_WIN32)
    auto together = [](unsigned long long*, int, auto& work) {{ work(0); }};
    auto yield_thread = [] {{}};
#else
#if defined(__APPLE__)
    #define SYMBOL(name) "_" name
#else
    #define SYMBOL(name) name
#endif
    typedef void* (*Start)(void*);
    extern int start_thread(unsigned long*, const void*, Start, void*) __asm__(SYMBOL("pthread_create"));
    extern int detach_thread(unsigned long) __asm__(SYMBOL("pthread_detach"));
    extern int yield_thread() __asm__(SYMBOL("sched_yield"));
    #undef SYMBOL
    typedef unsigned long long Word;
    static constexpr auto change = [](Word* state, Word from, Word to) -> bool {{
        return __atomic_compare_exchange_n(state, &from, to, false, __ATOMIC_ACQ_REL, __ATOMIC_RELAXED);
    }};
    auto serve = [](void* argument) -> void* {{
        Word* const member = (Word*)argument;
        for (int idle = 0;; ++idle) {{
            if (change(member + {_STATE}, {_POSTED}, {_WORKING})) {{
                ((void (*)(Word, int))member[{_CALL}])(member[{_JOB}], (int)member[{_NUMBER}]);
                __atomic_store_n(member + {_STATE}, {_WAITING}, __ATOMIC_RELEASE);
                idle = 0;
            }} else if (idle > {_PATIENCE} && change(member + {_STATE}, {_WAITING}, {_GONE})) {{
                return nullptr;
            }}
            yield_thread();
        }}
    }};
    auto together = [serve](Word* team, int threads, auto& work) {{
        typedef decltype(&work) Work;
        auto call = [](Word job, int number) {{ (*(Work)job)(number); }};
        Word* claimed[{MOST_THREADS}];
        int count = 0;
        for (int m = 0; m < {MOST_THREADS} && count < threads - 1; ++m) {{
            Word* const member = team + {_WORDS} * m;
            const bool waiting = change(member + {_STATE}, {_WAITING}, {_CLAIMED});
            if (!waiting && !change(member + {_STATE}, {_GONE}, {_CLAIMED})) continue;
            member[{_CALL}] = (Word)(void (*)(Word, int))call;
            member[{_JOB}] = (Word)&work;
            member[{_NUMBER}] = count + 1;
            __atomic_store_n(member + {_STATE}, {_POSTED}, __ATOMIC_RELEASE);
            claimed[count++] = member;
            if (waiting) continue;
            unsigned long id;
            if (start_thread(&id, nullptr, serve, member) == 0) {{
                detach_thread(id);
            }} else {{
                __atomic_store_n(member + {_STATE}, {_GONE}, __ATOMIC_RELEASE);
                --count;
                break;
            }}
        }}
        work(0);
        // to sleep until a thread has ended would take longer than to wait for it to say so
        for (int t = 0; t < count; ++t)
            while (!change(claimed[t] + {_STATE}, {_POSTED}, {_WAITING})
                   && __atomic_load_n(claimed[t] + {_STATE}, __ATOMIC_ACQUIRE) == {_WORKING})
                yield_thread();
    }};
#endif
"""
"""Text that defines ``together``, for native functions."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def team() -> wp.array:
    """The members' memory, one for the process; it is what ``together`` takes."""
    members = wp.zeros((MOST_THREADS, _WORDS), dtype=wp.uint64, device="cpu")
    atexit.register(_wait_until_all_have_left, members.numpy())
    return members


def _wait_until_all_have_left(members: np.ndarray) -> None:
    """Wait for threads that still look for work: the code that they run goes with the process's last modules."""
    for _ in range(100):
        if np.all(members[:, _STATE] == _GONE):
            return
        time.sleep(1e-3)
