"""Calls in child processes, so that a crash counts: it ends the child, and the next one makes the calls after it."""

import json
import os
import resource
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from typing import Any

from warpmag.show.blender import BLENDER

from .caller import Caller, Outcome

SECONDS, MEMORY = 60, 8 << 30
"""CPU time of a call [s], with kernels compiled, and address space of a child [bytes]."""


def _child(name: str, seed: int, numbers: list[int], outward: int, folder: str) -> None:
    """Make calls, which write files into a folder, and write a line before and after each; never return."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("ignore")
    os.environ[BLENDER] = shutil.which("true") or ""  # draws nothing, but arguments and stages are read
    silent = os.open(os.devnull, os.O_WRONLY)
    for descriptor in (1, 2):
        os.dup2(silent, descriptor)
    caller = Caller(name, seed)
    os.chdir(folder)

    def say(kind: str, *parts: Any) -> None:
        os.write(outward, json.dumps([kind, *parts]).encode() + b"\n")

    for number in numbers:
        used = resource.getrusage(resource.RUSAGE_SELF)
        limit = int(used.ru_utime + used.ru_stime) + SECONDS
        resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))
        outcome = caller.call(number, lambda text, number=number: say("begin", number, text))
        say("end", number, outcome.call, outcome.taken, outcome.problem)
    os._exit(0)


def outcomes(name: str, seed: int, numbers: list[int]) -> Iterator[Outcome]:
    """Yield what became of calls of one function; the problem of a call that ended its process is how it did."""
    with tempfile.TemporaryDirectory() as folder:
        yield from _outcomes(name, seed, list(numbers), folder)


def _outcomes(name: str, seed: int, left: list[int], folder: str) -> Iterator[Outcome]:
    while left:
        inward, outward = os.pipe()
        process = os.fork()
        if not process:
            os.close(inward)
            try:
                _child(name, seed, left, outward, folder)
            finally:
                os._exit(1)
        os.close(outward)
        last = ""
        with os.fdopen(inward, encoding="utf-8") as lines:
            for kind, number, call, *rest in map(json.loads, lines):
                last = call
                if kind == "end":
                    left.remove(number)
                    yield Outcome(number, call, *rest)
        _, status = os.waitpid(process, 0)
        if left:
            yield Outcome(left.pop(0), last, problem=f"its process ended with the status {status}")
