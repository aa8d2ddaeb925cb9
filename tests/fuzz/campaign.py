"""Sends spoiled stages through ``warpmag check`` and ``warpmag run --frames 1``, in processes that may die of it.

Workers fork from a process that has Newton imported and kernels loaded, so that a stage takes little longer than it
takes to read. A stage has to end in a run, or in one line that says what is wrong. All else is a problem.
"""

import contextlib
import json
import os
import random
import re
import resource
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path

from . import damage
from .mutate import mutate
from .sources import DRAWN
from .truth import differences

FORMS = ("usda",) * 13 + ("text",) * 3 + ("crate",) * 3 + ("package",)
"""Formats of mutants, in these proportions: text, damaged text, crate files, packages."""
CPU_SECONDS = 30
"""CPU time that a stage may take [s], for the mutant, ``check``, ``run``, ``render`` of textures, and the comparison of
results. Compilation of kernels does not count: users pay for it once for a version, not for a stage. Tables of shapes
count, unless they are in the cache already: begin a campaign without the folder ``warpmag_shapes``."""
KERNEL_SECONDS, WALL_SECONDS = 80, 600
"""CPU time beyond it after which a worker is killed [s], which contacts of a new kind of shape take to compile, and the
wall time after which it is, which allows for a loaded machine."""
MEMORY = 8 << 30
"""Address space of a worker [bytes]."""
OK, FAILED, BAD_INPUT = 0, 1, 2
_LONGEST_LINE = 1000
_ROOT = Path(__file__).resolve().parents[2]
_FRESH = {name: value for name, value in os.environ.items() if name != "PXR_WORK_THREAD_LIMIT"}
_CAUSES = ("overlapped at the start", "apart at the start", "too fast for the shortest substep")
"""What may end a run of a sound stage, and has to be named then."""
_SMALL = ("--size", "16x9", "--device")
_READING = re.compile("USD's reader crashes on it|USD did not read it within")
_NETWORK = ("socket.connect", "socket.getaddrinfo", "socket.gethostbyname", "socket.sendto", "urllib.Request")
_DEVICES = re.compile(r"/dev/(?!null$)|/proc/self/mem|(pipe|link)\.png$")
"""Events of Python that reach a network, and names that must not be opened."""
_EXPECTED = re.compile(r"^warpmag: |^$|^\S+: (loading|compiling)|frame/s|s/frame|frame \[")


@dataclass
class Verdict:
    """What became of one mutant.

    Attributes:
        number: Which one.
        form: One of ``FORMS``.
        done: What was done to the stage.
        check: Exit code of ``warpmag check``.
        run: Exit code of ``warpmag run``.
        line: The one line by which the run was refused.
        problems: What must not happen.
        seconds: CPU time with that of child processes, without the compilation of kernels in this process [s].
    """

    number: int
    form: str = ""
    done: str = ""
    check: int | None = None
    run: int | None = None
    line: str = ""
    problems: list[str] = field(default_factory=list)
    seconds: float = 0.0


class _Reached:
    """Forbidden files and connections that this process opens, as Python's audit hooks see them.

    A hook stays for as long as the process: there is one of them, from the first use.
    """

    def __init__(self):
        self.places, self._hooked = [], False

    def begin(self) -> None:
        """Forget what was reached."""
        self.places.clear()
        if not self._hooked:
            self._hooked = True
            sys.addaudithook(self._hear)

    def _hear(self, event, arguments):
        if event in _NETWORK:
            self.places.append(f"{event} {arguments!r:.100}")
        elif event == "open" and isinstance(arguments[0], str) and _DEVICES.search(arguments[0]):
            self.places.append(f"open {arguments[0]}")


_reached = _Reached()


class _Kernels:
    """CPU time that this process takes to compile and load kernels.

    Attributes:
        seconds: The time so far, from the first :meth:`begin` [s].
    """

    def __init__(self):
        self.seconds, self._watched = 0.0, False

    def begin(self) -> None:
        """Measure loads of kernels from now on. Loads are not nested; each thread has its own time."""
        if self._watched:
            return
        import warp as wp  # noqa: PLC0415 - a worker has it imported

        self._watched, load = True, wp.Module.load

        def timed_load(*arguments, **named):
            began = time.thread_time()
            try:
                return load(*arguments, **named)
            finally:
                self.seconds += time.thread_time() - began

        wp.Module.load = timed_load


_kernels = _Kernels()


def make(number: int, seed: int, folder: Path, sources: list[Path]) -> tuple[Path, str, str]:
    """Write one mutant; return its file, its form and what was done to it."""
    chance = random.Random(f"{seed}-{number}")
    form, source = chance.choice(FORMS), sources[number % len(sources)]
    path = folder / f"{number:05}.usda"
    done, layer = mutate(source, path, chance.randrange(1 << 40), fewest=0 if form == "text" else 1)
    if form == "text":
        done += "; " + damage.spoil_text(path, chance)
    elif form != "usda":
        path = damage.to_crate(layer, path) if form == "crate" else damage.to_package(layer, path, chance)
    return path, form, f"{source.stem}: {done}"


def warm_up(stages: list[Path], command: Callable, together: int = 1) -> None:
    """Run sound stages: in fresh processes to have their kernels compiled, in this one to have them loaded.

    Fresh ones have no limits, and may run ``together``. Else all workers would compile the same kernels at first, and
    be killed for it. The stage :data:`sources.DRAWN` is drawn, too.
    """

    def run(stage):
        commands = [("run", str(stage), "--frames", "1", "--device", "cpu", "-o", f"{folder}/{stage.stem}.out.usda")]
        if stage.name == DRAWN:
            commands.append(("render", str(stage), "-o", f"{folder}/out.png", *_SMALL, "cpu"))
        for arguments in commands:
            code, _, said = command(*arguments)
            if code != OK:
                raise RuntimeError(f"{stage}: {said}")

    with tempfile.TemporaryDirectory() as folder:
        if together > 1:
            with ThreadPoolExecutor(together) as pool:
                list(pool.map(run, stages))
        else:
            for stage in stages:
                run(stage)


def judge(number: int, seed: int, folder: Path, sources: list[Path], command: Callable, device: str = "cpu") -> Verdict:
    """Make a mutant, send it through ``check`` and ``run``, and look at what came of it."""
    began = cpu_seconds() - _kernels.seconds
    verdict = Verdict(number)
    place = folder / f"{number:05}"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    path, verdict.form, verdict.done = make(number, seed, place, sources)
    (place / "done.txt").write_text(json.dumps([verdict.form, verdict.done]), encoding="utf-8")
    output = place / "out" / "out.usda"
    _reached.begin()
    with _recorded() if command is in_process else contextlib.nullcontext([]) as simulations:
        verdict.check, report, stderr_of_check = command("check", str(path))
        verdict.run, _, stderr_of_run = command(
            "run", str(path), "--frames", "1", "--device", device, "-o", str(output)
        )
    if verdict.run == OK and "texture" in verdict.done:  # which a picture alone reads
        shown, _, stderr_of_render = command("render", str(path), "-o", str(place / "out.png"), *_SMALL, device)
        verdict.problems += talk("render", stderr_of_render)
        if shown != OK and len(messages(stderr_of_render)) != 1:
            verdict.problems.append(f"render ends with {shown}: {messages(stderr_of_render)}"[:300])
    errors = [line[12:] for line in report if line.startswith("error ")] + messages(stderr_of_check)
    refusals = messages(stderr_of_run)
    verdict.line = refusals[-1] if refusals else ""
    verdict.problems += [*talk("check", stderr_of_check), *talk("run", stderr_of_run)]
    verdict.problems += [f"reached {place}" for place in _reached.places]
    verdict.problems += _disagreements(verdict.check, errors, verdict.run, refusals)
    if verdict.run == BAD_INPUT and output.exists():
        verdict.problems.append("a refused run wrote")
    if verdict.run == FAILED and not any(cause in verdict.line for cause in _CAUSES):
        verdict.problems.append(f"failed: {verdict.line}")
    if verdict.run == OK:
        verdict.problems += differences(path, output, simulations[-1] if simulations else None)
    verdict.seconds = cpu_seconds() - _kernels.seconds - began
    return verdict


def cpu_seconds() -> float:
    """Return the CPU time of this process and of its children that have ended [s]."""
    return sum(os.times()[:4])


@contextlib.contextmanager
def _recorded() -> Iterator[list]:
    """Keep the simulations that are run meanwhile."""
    from warpmag.engine.stepping.simulation import Simulation  # noqa: PLC0415 - a worker has it imported

    simulations, before = [], Simulation.run

    def run(self, *arguments, **options):
        simulations.append(self)
        return before(self, *arguments, **options)

    Simulation.run = run
    try:
        yield simulations
    finally:
        Simulation.run = before


def in_process(*arguments: str) -> tuple[int, list[str], list[str]]:
    """Run the command in this process; return its exit code and its lines on stdout and stderr."""
    from warpmag import cli  # noqa: PLC0415

    with _caught(1) as out, _caught(2) as err:
        try:
            code = cli.main(list(arguments))
        except BaseException:
            traceback.print_exc()
            code = -1
    return code, out[0].splitlines(), err[0].splitlines()


def in_fresh_process(*arguments: str) -> tuple[int, list[str], list[str]]:
    """Do the same in a fresh interpreter."""
    done = subprocess.run(
        [sys.executable, "-m", "warpmag.cli", *arguments], capture_output=True, check=False, env=_FRESH, cwd=_ROOT
    )
    out, err = (stream.decode(errors="replace").splitlines() for stream in (done.stdout, done.stderr))
    return done.returncode, out, err if done.returncode >= 0 else [*err, f"died of signal {-done.returncode}"]


@contextlib.contextmanager
def _caught(descriptor: int) -> Iterator[list[str]]:
    """Catch what is written to a file descriptor, by native code as well, and to Python's stream of it."""
    name = {1: "stdout", 2: "stderr"}[descriptor]
    stream, text = getattr(sys, name), []
    stream.flush()
    before = os.dup(descriptor)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), descriptor)
        # pytest's stream writes to a file of its own
        setattr(sys, name, os.fdopen(os.dup(descriptor), "w", encoding="utf-8", errors="replace"))
        try:
            yield text
        finally:
            getattr(sys, name).close()
            setattr(sys, name, stream)
            os.dup2(before, descriptor)
            os.close(before)
            file.seek(0)
            text.append(file.read().decode(errors="replace"))


def messages(lines: list[str]) -> list[str]:
    """Return the errors among lines on stderr."""
    return [
        line.removeprefix("warpmag: ")
        for line in lines
        if line.startswith("warpmag: ") and not line.startswith("warpmag: warning: ")
    ]


def talk(command: str, lines: list[str]) -> list[str]:
    """Return what a command must not have written to stderr."""
    if any(line.startswith("Traceback") for line in lines):
        return [f"{command}: traceback: {lines[-1][:200]}"]
    # a warning erases the bar above it with blanks
    strange = [line for line in lines if line.strip() and not _EXPECTED.search(line)]
    problems = [f"{command}: said {strange[0][:200]!r} and {len(strange) - 1} lines more"] if strange else []
    if len(messages(lines)) > 1:
        problems.append(f"{command}: {len(messages(lines))} lines of errors")
    return problems + [f"{command}: a line of {len(line)}" for line in lines if len(line) > _LONGEST_LINE]


def _disagreements(check: int, errors: list[str], run: int, refusals: list[str]) -> list[str]:
    """Return what ``check`` and ``run`` do not say alike."""
    if (check == BAD_INPUT) != (run == BAD_INPUT):
        return [f"check ends with {check}, run with {run}: {(errors or refusals or ['nothing said'])[0][:200]}"]
    if all(lines and _READING.search(lines[0]) for lines in (errors, refusals)):  # now it takes too long, now too much
        return []
    if run == BAD_INPUT and refusals and refusals[0] not in errors:
        return [f"run says {refusals[0][:150]!r}, check {errors[0][:150] if errors else 'nothing'!r}"]
    return []


@dataclass
class Campaign:
    """Many mutants, so and so many to a worker process, and so and so many workers at a time.

    What becomes of a mutant depends on seed and number alone, so that neither changes the result.

    Attributes:
        seed: Which ones.
        folder: Where they are written; those without problems are removed again.
        sources: Stages that are spoiled.
        batch: Mutants that one worker does before the next one starts.
        workers: Workers at a time.
        fresh: Whether each command gets an interpreter of its own.
        keep: Whether mutants without problems are kept, too.
        trial: Function that makes a mutant of the sources and returns its verdict.
    """

    seed: int
    folder: Path
    sources: list[Path]
    batch: int = 1
    workers: int = 1
    fresh: bool = False
    keep: bool = False
    trial: Callable[..., Verdict] = field(default_factory=lambda: judge)

    def verdicts(self, numbers: list[int]) -> Iterator[Verdict]:
        """Yield what became of each of the mutants, in the order in which they end."""
        left, running, shares = list(numbers), selectors.DefaultSelector(), self._shares()
        while left or running.get_map():
            while left and shares:
                worker = _Worker(self, left[: self.batch], shares.pop())
                running.register(worker.results, selectors.EVENT_READ, worker)
                del left[: self.batch]
            ready = [key.data for key, _ in running.select(timeout=1.0)]
            for worker in [key.data for key in running.get_map().values()]:
                verdicts, ended = worker.heard() if worker in ready else worker.late()
                if ended:
                    running.unregister(worker.results)
                    verdicts += worker.end()
                    left[:0] = worker.left
                    shares.append(worker.share)
                for verdict in verdicts:
                    if not (verdict.problems or self.keep):
                        shutil.rmtree(self.folder / f"{verdict.number:05}")
                    yield verdict

    def _shares(self) -> list[list[int]]:
        """Cores of each worker: threads that wait for each other on all cores would use up each other's time."""
        cores = sorted(os.sched_getaffinity(0))
        return [cores[k :: self.workers] or [cores[k % len(cores)]] for k in range(self.workers)]

    def work(self, numbers: list[int], share: list[int], outward: int) -> None:
        """Be a worker on its share of the cores that writes its verdicts to a pipe, and never return."""
        os.sched_setaffinity(0, share)
        if not self.fresh:  # CUDA's driver takes more addresses than that when it starts
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        command = in_fresh_process if self.fresh else in_process
        _kernels.begin()
        for number in numbers:
            limit = int(time.process_time()) + CPU_SECONDS + KERNEL_SECONDS  # of this process alone
            resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))
            try:
                verdict = self.trial(number, self.seed, self.folder, self.sources, command)
                if verdict.seconds > CPU_SECONDS and not self.fresh:  # starts of interpreters are no stage's fault
                    verdict.problems.append(f"took {verdict.seconds:.0f} s of CPU time")
            except BaseException:
                verdict = Verdict(number, problems=[traceback.format_exc()])
            os.write(outward, json.dumps(asdict(verdict)).encode() + b"\n")
        os._exit(0)


class _Worker:
    """A worker process, as the campaign sees it.

    Attributes:
        results: The pipe of its verdicts.
        left: Mutants that it has not done yet.
        share: Cores that it runs on.
    """

    def __init__(self, campaign: Campaign, numbers: list[int], share: list[int]):
        self._folder, self.left, self.share = campaign.folder, list(numbers), share
        self.results, outward = os.pipe()
        self._process = os.fork()
        if not self._process:
            os.close(self.results)
            campaign.work(numbers, share, outward)
        os.close(outward)
        self._begun, self._heard, self._hung = b"", time.monotonic(), False

    def heard(self) -> tuple[list[Verdict], bool]:
        """Return the verdicts that have come, and whether these were all."""
        data = os.read(self.results, 1 << 20)
        *lines, self._begun = (self._begun + data).split(b"\n")
        verdicts = [Verdict(**json.loads(line)) for line in lines]
        for verdict in verdicts:
            self.left.remove(verdict.number)
        self._heard = time.monotonic()
        return verdicts, not data

    def late(self) -> tuple[list[Verdict], bool]:
        """Return whether it hangs, which ends it, in the form of :meth:`heard`."""
        self._hung = time.monotonic() - self._heard > WALL_SECONDS
        if self._hung:
            os.kill(self._process, signal.SIGKILL)
        return [], self._hung

    def end(self) -> list[Verdict]:
        """Wait for its end; return a verdict about the mutant that it died of, if it did."""
        os.close(self.results)
        _, status = os.waitpid(self._process, 0)
        if not self.left:
            return []
        number = self.left.pop(0)
        died = f"died of {signal.Signals(os.WTERMSIG(status)).name if os.WIFSIGNALED(status) else status}"
        note = self._folder / f"{number:05}" / "done.txt"
        form, done = json.loads(note.read_text(encoding="utf-8")) if note.exists() else ("", "the mutator itself")
        return [Verdict(number, form, done, problems=[f"hung for {WALL_SECONDS} s" if self._hung else died])]
