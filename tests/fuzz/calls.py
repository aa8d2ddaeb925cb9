"""``python -m tests.fuzz.calls``: wild calls of every public function that takes builders, models, states or arrays.

    python -m tests.fuzz.calls --count 2000 --seed 7           so many calls of each function
    python -m tests.fuzz.calls --count 100 --only apply        of functions with ``apply`` in their names

Each call has one to three wild arguments among right ones: numbers, texts, arrays of other sizes, types and memory,
states and models of other worlds. It must end in an ``InputError`` of one line or in finite results. The calls run in
child processes, so that a crash counts; it ends the child, and the next one goes on behind the call that did it.
Simulations and displays take seconds to build. A child process builds them again only after a call that was not
refused.
``warpmag.torch`` and ``warpmag.jax`` are called where their libraries are installed.
"""

import argparse
import inspect
import json
import math
import multiprocessing
import os
import random
import resource
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, fields, is_dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import newton
import numpy as np
import warp as wp

import warpmag
from warpmag.declarations.keys import Keys
from warpmag.moments.probe import FieldProbe

SECONDS, MEMORY = 60, 8 << 30
"""CPU time of a call [s], with kernels compiled, and address space of a child [bytes]."""
M = (0.0, 0.0, 1e6)
POINTS = np.array([(0.0, 0.0, 0.05), (0.02, 0.0, 0.0)])
KEYS = Keys(np.array([0.0, 1.0]), np.array([[1.0], [2.0]]), "linear").to_text()
TIME_STEP = 1e-3  # s
STAGE = str(Path(__file__).with_name("workshop.usda"))
OFTEN = 50
"""Calls without arguments after which a world is made anew; calls with arguments make it anew if they were taken."""
KINDS = "coils", "worlds", "gradients", "distant"
"""Kinds of worlds, each for ``OFTEN`` calls in turn: one with coils, two of it in a model, one whose model requires
gradients, which voltages of coils have not, and one with a plate that acts by few moments, which coils do not allow."""


def new_world(balls: int = 2, kind: str = "coils") -> dict[str, Any]:
    """Return right arguments by name: a model of balls, iron, coils and a site, with all that takes its states."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    for number in range(balls):
        body = builder.add_body(xform=wp.transform((0.0, 0.0, 0.015 * number), wp.quat_identity()))
        builder.add_shape_sphere(body, radius=0.005)
        builder.add_shape_sphere(body, xform=wp.transform((0.0, 0.02, 0.0), wp.quat_identity()), radius=0.001)
        if number % 2:
            warpmag.add_inducible(builder, body=body)
        else:
            warpmag.add_permanent(builder, body=body, magnetization=M)
    builder.add_site(0, label="site")
    coil = _add_plate(builder) if kind == "distant" else warpmag.add_coil(builder, body=0, radius=0.01, label="coil")
    if kind in ("coils", "worlds"):
        warpmag.add_coil(builder, body=0, radius=0.01, wire_radius=1e-4, resistance=1.0, turns=10, label="driven")
    scene = builder
    if kind == "worlds":
        scene = newton.ModelBuilder()
        warpmag.register_attributes(scene)
        scene.replicate(builder, 2)
    model = scene.finalize(device="cpu", requires_grad=kind == "gradients")
    if kind != "distant":
        model.warpmag.current_keys[coil] = KEYS  # as USD's importer leaves them
    magnetics, state = warpmag.Magnetics(model), model.state()
    magnetics.apply(state, dt=TIME_STEP)
    viewer = newton.viewer.ViewerNull()
    return {
        **{"builder": builder, "scene": builder, "model": model, "state": state, "magnetics": magnetics},
        **{"viewer": viewer, "control": model.control(), "positions": POINTS, "points": POINTS, "body": 0},
        **{
            "sites": "site",
            "coil": coil,
            "ampere_turns": 2.0,
            "voltage": 2.0,
            "external_field": (0.0, 0.0, 1e4),
            "count": 2,
            "dt": TIME_STEP,
        },
        **{"magnetization": M, "magnetizations": {1: M}, "material": "iron", "time": 0.0, "frames": 1, "radius": 0.005},
        **{"origin": (0.0, 0.0, 0.0), "spacing": 0.01, "values": np.ones((3, 3, 3, 3)), "name": "iron"},
        **{"fields": [0.0, 1e3, 1e5], "flux_densities": [0.0, 1.0, 1.5], "path": os.devnull, "output": None},
        **{
            "moments": np.ones((2, 3)),
            "radii": 0.005,
            "saturation": 1.3e6,
            "device": "cpu",
            "dtype": "float32",
            "system": magnetics.system,
            "worlds": np.zeros(len(POINTS), np.int32),
            "gradients": True,
            "kind": kind,
        },
    } | {"sensor": warpmag.SensorMagnetometer(model, magnetics, "site"), "probe": FieldProbe(magnetics.system, 2)}


def _add_plate(builder: newton.ModelBuilder) -> int:
    """Add a plate of iron of more than 64 cells, far from the balls; return its shape."""
    plate = builder.add_body(xform=wp.transform((0.5, 0.0, 0.0), wp.quat_identity()))
    shape = builder.add_shape_box(plate, hx=0.03, hy=0.03, hz=0.0015)
    warpmag.add_inducible(builder, body=plate)
    return shape


def _importable(*names: str) -> dict[str, ModuleType]:
    """Return the modules of warpmag whose libraries are installed, by the last part of their names."""
    modules = {}
    for name in names:
        with suppress(ImportError):
            modules[name] = import_module(f"warpmag.{name}")
    return modules


# functions of a world, by what has to be made before the call; the arguments are those of the signature
OWNERS: dict[str, Callable[[dict], Any]] = {
    "Magnetics": lambda world: world["magnetics"],
    "SensorMagnetometer": lambda world: world["sensor"],
    "FieldProbe": lambda world: world["probe"],
    "KeyedCurrents": lambda world: warpmag.KeyedCurrents(world["model"]),
    "Display": lambda world: warpmag.Display(world["viewer"], world["model"], world["magnetics"]),
    "Simulation": lambda world: warpmag.Simulation(new_builder(world), device="cpu"),
}
CLASSES = {"FieldProbe": FieldProbe, **{name: getattr(warpmag, name) for name in OWNERS if name != "FieldProbe"}}
ARRAYS = ("solve_induction", "h_field", "wrench")
FUNCTIONS = (
    *("register_attributes", "register_custom_attributes", "add_inducible", "add_permanent", "add_balls", "add_coil"),
    *("add_field_map", "material", "check", "sweep", "render", "export", *ARRAYS),
)
CURVES = ("from_bh", "from_mh", "from_csv")
LIBRARIES = _importable("torch", "jax")
SINGLE = {
    "MagnetizationCurve.from_mh": {"magnetizations": [0.0, 5e5, 1e6]},
    "MagnetizationCurve.from_csv": {"path": str(Path(__file__).with_name("curve.csv"))},
    "Magnetics.set_voltage": {"coil": "driven"},
    "sweep": {"simulate": list, "world_count": 4, "together": 2},
    "render": {"stage": STAGE, "output": "calls.png", "size": (16, 9), "frame": 0, "on_camera": str},
    "export": {"stage": STAGE, "output": "calls.usdc"},
}
"""Right arguments of one function alone."""
USUAL = ("body", "magnetization", "saturation", "radius", "device", "dtype", "dt", "worlds", "gradients", "size")
"""Optional arguments that are given in most calls, as users do."""
PASSIVE = {"persistent_arrays", "stepped_arrays", "warnings", "frame", "allow_restart", "stay"}
"""Methods without arguments that return no numbers, or only when a viewer is closed."""


def new_builder(world: dict) -> newton.ModelBuilder:
    """Return a builder of a ball as a magnet, which a simulation may change."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    builder.add_shape_sphere(builder.add_body(), radius=0.005)
    warpmag.add_permanent(builder, body=0, magnetization=M)
    return builder


def targets() -> dict[str, Callable[[Callable[[str], Any]], Callable]]:
    """Return every public function by name: functions, constructors, methods and settable properties.

    Each is got from a function that returns an owner of :data:`OWNERS` by its name.
    """
    found: dict[str, Callable[[Callable[[str], Any]], Callable]] = {}
    for name in FUNCTIONS:
        found[name] = lambda owned, name=name: getattr(warpmag, name)
    for name in CURVES:
        found[f"MagnetizationCurve.{name}"] = lambda owned, name=name: getattr(warpmag.MagnetizationCurve, name)
    for library, module in LIBRARIES.items():
        for name in ARRAYS:
            found[f"{library}.{name}"] = lambda owned, module=module, name=name: getattr(module, name)
    for owner in OWNERS:
        found[owner] = lambda owned, owner=owner: CLASSES[owner]
        for name, member in vars(CLASSES[owner]).items():
            if name.startswith("_") or name in PASSIVE:
                continue
            if inspect.isfunction(member):
                found[f"{owner}.{name}"] = lambda owned, owner=owner, name=name: getattr(owned(owner), name)
            elif isinstance(member, property) and member.fset:
                found[f"{owner}.{name}"] = lambda owned, owner=owner, name=name: _setter(owned(owner), name)
    return found


def _setter(owner: Any, name: str) -> Callable:
    def assign(control):
        setattr(owner, name, control)

    return assign


def wild(chance: random.Random, world: dict) -> Any:
    """Return a value that few functions expect."""
    number = chance.choice((0, -1, 1, 2, 3, 7, 2**31, 10**40, -(2**63), 0.5, 1e-30, 1e30, 1e300, math.nan, math.inf))
    kind = chance.randrange(12)
    if kind < 2:
        return chance.choice((number, np.float32(min(number, 1e38)), np.int64(3), True, 1j, wp.float64(0.5)))
    if kind == 2:
        return chance.choice(("", "x", "*", "site", "cuda:9", "a" * 5000, "[", b"x", Path("/nowhere"), "\0", "tanh"))
    if kind == 3:
        texts, view = np.array(["1.0", "2", "x"]), memoryview(b"\1\2\3")
        odd = (
            texts,
            texts[0],
            texts.astype("S"),
            texts.astype(object),
            {1.0, 2.0, 3.0},
            {0: 1.0, 1: 2.0, 2: 3.0},
            view,
        )
        several = (None, object(), [], {}, (), set(), lambda *_: None, str, [[1.0], [2.0, 3.0]], [None])
        return chance.choice((*several, *odd, range(3), bytearray(3), np.ones(3, bool), np.ones(3, "m8[s]")))
    if kind < 6:
        shape = chance.choice(((), (0,), (1,), (3,), (2, 3), (5, 3), (0, 3), (3, 1), (2, 7), (1, 2, 3), (1000, 3)))
        array = np.full(shape, chance.choice((0.0, 1.0, 1e-9, float(max(min(number, 1e300), -1e300)))))
        if "torch" in LIBRARIES and chance.random() < 0.2:
            return LIBRARIES["torch"].torch.tensor(array, requires_grad=chance.random() < 0.3)
        return chance.choice((array, array.astype(np.float32), array.astype("U5"), array[::-1] if shape else array))
    if kind < 9:
        dtype = chance.choice((float, wp.float64, int, wp.vec3, wp.vec3d, wp.quat, wp.transform, wp.spatial_vector))
        size = chance.choice((0, 1, 2, 3, 7, 1000, (2, 2), (3, 1)))
        array = wp.zeros(size, dtype=dtype, device="cpu")
        return array[::2] if array.ndim == 1 and array.size > 1 and chance.random() < 0.3 else array
    other = world if kind == 9 else _others(chance)
    return other[chance.choice(sorted(other))]


def _others(chance: random.Random, cache: dict = {}) -> dict:  # noqa: B006 - worlds of other sizes, made once
    balls = chance.choice((1, 3, 7))
    if balls not in cache:
        cache[balls] = new_world(balls)
    return cache[balls]


@dataclass
class Outcome:
    """The end of a call: its number, ``taken`` if it was not refused, and its problem, empty without one."""

    number: int
    call: str = ""
    taken: bool = False
    problem: str = ""


@dataclass
class Caller:
    """Makes calls of one function."""

    name: str
    seed: int
    world: dict = field(default_factory=dict)
    owners: dict[str, Any] = field(default_factory=dict)

    def _owned(self, owner: str) -> Any:
        """Return an owner of the function, made once for a world."""
        if owner not in self.owners:
            self.owners[owner] = OWNERS[owner](self.world)
        return self.owners[owner]

    def _right(self) -> dict:
        """Return right arguments of the function by name, and others."""
        right = self.world | SINGLE.get(self.name, {})
        if self.name.endswith(".reset"):
            right["worlds"] = np.ones(max(self.world["model"].world_count, 1), bool)
        if self.name == "Simulation.control":
            right["control"] = self._owned("Simulation").model.control()
        if self.world["kind"] == "gradients" and self.name in ARRAYS:
            right["positions"] = wp.array(POINTS, dtype=wp.vec3, device="cpu", requires_grad=True)
        if self.name.startswith("torch."):
            tensor = LIBRARIES["torch"].torch.tensor
            right |= {name: tensor(value) for name, value in right.items() if isinstance(value, np.ndarray)}
            right["positions"].requires_grad_(self.world["kind"] == "gradients")
        return right

    def call(self, number: int, announce: Callable[[str], Any] = lambda _: None) -> Outcome:
        """Make one call, and a right one after it; return what became of it."""
        chance = random.Random(f"{self.seed}-{self.name}-{number}")
        kind = KINDS[number // OFTEN % (3 if self.name.startswith("KeyedCurrents") else 4)]  # which need a coil
        if self.world.get("kind") != kind:
            self.world, self.owners = new_world(kind=kind), {}
        function, right = targets()[self.name](self._owned), self._right()
        names = [name for name in inspect.signature(function).parameters if name not in ("args", "options", "overlays")]
        parameters = inspect.signature(function).parameters
        needed = [name for name in names if parameters[name].default is inspect.Parameter.empty]
        needed += [name for name in names if name in USUAL and name not in needed and chance.random() < 0.8]
        arguments = {name: right[name] for name in needed}
        for name in chance.sample(names, min(len(names), chance.choice((0, 1, 1, 1, 2, 3)))):
            arguments[name] = wild(chance, self.world)
        outcome = Outcome(number, f"{self.name}({', '.join(f'{k}={_short(v)}' for k, v in arguments.items())})")
        announce(outcome.call)
        try:
            with wp.Tape() if kind == "gradients" else nullcontext() as tape:
                result = function(**arguments)
            outcome.taken = True
            gradients = _gradients(result, arguments.get("positions"), tape) if self.name.endswith(ARRAYS) else []
            if not all(np.isfinite(array).all() for array in (*_numbers(result), *gradients)):
                outcome.problem = f"not finite: {_short(result)}"
        except warpmag.InputError as error:
            if "\n" in str(error) or not 0 < len(str(error)) < 1000:
                outcome.problem = f"a message of {len(str(error))}: {error}"[:300]
        except warpmag.SimulationError:
            pass
        except BaseException as error:
            if isinstance(error, MemoryError) or not _raised_by(error, arguments):
                outcome.problem = f"{type(error).__name__}: {error}"[:200] + traceback.format_exc()[-500:]
        if outcome.taken and (names or number % OFTEN == 0):
            self._go_on(outcome)
        return outcome

    def _go_on(self, outcome: Outcome) -> None:
        """Use what the call was about, then replace it."""
        try:
            magnetics, state = self.world["magnetics"], self.world["model"].state()
            with wp.Tape() as tape:
                magnetics.apply(state, dt=TIME_STEP)
            arrays = [state.body_f.numpy(), magnetics.b_field(POINTS)]
            if state.requires_grad:
                tape.backward(grads={state.body_f: wp.ones_like(state.body_f)})
                arrays.append(state.body_q.grad.numpy())
            if simulation := self.owners.get("Simulation"):
                simulation.step()
                arrays.append(simulation.state.body_q.numpy())
            if not all(np.isfinite(array).all() for array in arrays):
                outcome.problem = outcome.problem or "forces, fields or poses are not finite after it"
        except (warpmag.InputError, warpmag.SimulationError):
            pass
        except BaseException as error:
            outcome.problem = outcome.problem or f"later {type(error).__name__}: {error}"[:300]
        self.world, self.owners = {}, {}


def _raised_by(error: BaseException, arguments: dict) -> bool:
    """Return True for the error of a function that was an argument, and for an ``InputError`` that JAX passes on."""
    if type(error).__name__ == "JaxRuntimeError" and "InputError: " in str(error):
        return True
    code = [value.__code__ for value in arguments.values() if inspect.isfunction(value)]
    return any(frame.f_code in code for frame, _ in traceback.walk_tb(error.__traceback__))


def _numbers(result: Any) -> Iterator[np.ndarray]:
    for part in _parts(result):
        if isinstance(part, wp.array) and part.dtype in (wp.float32, wp.vec3):
            yield part.numpy()
        elif hasattr(part, "detach"):
            yield part.detach().numpy()
        elif isinstance(part, np.ndarray | float):
            yield np.asarray(part)


def _gradients(result: Any, positions: Any, tape: wp.Tape | None) -> list[np.ndarray]:
    """Return the gradients of the sum of the results by the positions, if they require one."""
    parts = [part for part in _parts(result) if getattr(part, "requires_grad", False)]
    if not parts or not getattr(positions, "requires_grad", False):
        return []
    if isinstance(parts[0], wp.array):
        tape.backward(grads={part: wp.ones_like(part) for part in parts})
        return [positions.grad.numpy()]
    sum(part.sum() for part in parts).backward()
    return [positions.grad.numpy()]


def _parts(result: Any) -> list:
    """Return the arrays of a result: of a sequence, of the fields of a dataclass, or itself."""
    if is_dataclass(result):
        return [getattr(result, entry.name) for entry in fields(result)]
    return list(result) if isinstance(result, tuple | list) else [result]


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray | wp.array):
        return f"{type(value).__module__.split('.')[0]}.{getattr(value.dtype, '__name__', value.dtype)}{value.shape}"
    return " ".join(repr(value).split())[:80]


def _child(name: str, seed: int, numbers: list[int], outward: int, folder: str) -> None:
    """Make calls, which write files into a folder, and write a line before and after each; never return."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("ignore")
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


def main() -> int:
    """Make calls of all functions, and print a line about each function and each problem."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200, help="calls of each function (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="which calls (default: %(default)s)")
    parser.add_argument("--only", default="", help="part of the names of the functions")
    parser.add_argument("--without", default="-", help="part of the names of functions that are left out")
    parser.add_argument("--workers", type=int, default=1, help="functions at a time (default: %(default)s)")
    options = parser.parse_args()
    for kind in KINDS:  # kernels are compiled before the first fork
        new_world(kind=kind)
    names = [name for name in targets() if options.only in name and options.without not in name]
    calls = partial(_all_outcomes, seed=options.seed, count=options.count)
    total = 0
    with multiprocessing.get_context("fork").Pool(options.workers) as pool:
        for name, results in pool.imap_unordered(calls, names):
            bad = [outcome for outcome in results if outcome.problem]
            total += len(bad)
            taken = sum(outcome.taken for outcome in results)
            print(f"{name:36} {len(results):6} calls {taken:6} taken {len(bad):6} problems", flush=True)
            for outcome in bad[:5]:
                print(f"    {outcome.number}: {outcome.call[:300]}\n        {outcome.problem}", flush=True)
    print(f"{len(names)} functions, {total} problems")
    return 1 if total else 0


def _all_outcomes(name: str, seed: int, count: int) -> tuple[str, list[Outcome]]:
    """Return the name of a function and :func:`outcomes` of its first ``count`` calls."""
    return name, list(outcomes(name, seed, list(range(count))))


if __name__ == "__main__":
    sys.exit(main())
