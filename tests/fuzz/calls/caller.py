"""One call with wild arguments among right ones: what became of it, and whether its results are finite."""

import inspect
import random
import traceback
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

import warpmag

from .functions import ARRAYS, LIBRARIES, OWNERS, SINGLE, USUAL, targets
from .results import gradients, numbers, short
from .stages import INVALID_PRIMS
from .wild import wild
from .worlds import KINDS, OFTEN, POINTS, TIME_STEP, new_world


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
        """Return an owner of the function, made once for a world, or the world itself."""
        if owner == "world":
            return self.world
        if owner not in self.owners:
            self.owners[owner] = OWNERS[owner](self.world)
        return self.owners[owner]

    def _right(self) -> dict:
        """Return right arguments of the function by name, and others."""
        right = self.world | SINGLE.get(self.name, {})
        if self.name.endswith(".reset"):
            right["worlds"] = np.ones(max(self.world["model"].world_count, 1), bool)
        if self.name.startswith("usd."):
            right |= {"stage": self.world["scene_stage"], "coil": self.world["loop"]}
        if self.name == "Simulation.control":
            right["control"] = self._owned("Simulation").model.control()
        if self.world["kind"] == "gradients" and self.name in ARRAYS:
            right["positions"] = wp.array(POINTS, dtype=wp.vec3, device="cpu", requires_grad=True)
        if self.name.startswith("torch."):
            tensor = LIBRARIES["torch"].torch.tensor
            right |= {name: tensor(value) for name, value in right.items() if isinstance(value, np.ndarray)}
            right["positions"].requires_grad_(self.world["kind"] == "gradients")
        return right

    def _draw_arguments(self, parameters: Mapping[str, inspect.Parameter], chance: random.Random) -> dict[str, Any]:
        """Return right arguments with wild ones among them."""
        right = self._right()
        several = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
        names = [name for name, parameter in parameters.items() if parameter.kind not in several]
        needed = [name for name in names if parameters[name].default is inspect.Parameter.empty]
        needed += [name for name in names if name in USUAL and name not in needed and chance.random() < 0.8]
        arguments = {name: right[name] for name in needed}
        others = self.world | (INVALID_PRIMS if self.name.startswith("usd.") else {})
        for name in chance.sample(names, min(len(names), chance.choice((0, 1, 1, 1, 2, 3)))):
            arguments[name] = wild(chance, others)
        return arguments

    def call(self, number: int, announce: Callable[[str], Any] = lambda _: None) -> Outcome:
        """Make one call, and a right one after it; return what became of it."""
        chance = random.Random(f"{self.seed}-{self.name}-{number}")
        kind = KINDS[number // OFTEN % (3 if self.name.startswith("KeyedCurrents") else 4)]  # which need a coil
        if self.world.get("kind") != kind:
            self.world, self.owners = new_world(kind=kind), {}
        function = targets()[self.name](self._owned)
        parameters = inspect.signature(function).parameters
        arguments = self._draw_arguments(parameters, chance)
        outcome = Outcome(number, f"{self.name}({', '.join(f'{k}={short(v)}' for k, v in arguments.items())})")
        announce(outcome.call)
        try:
            with wp.Tape() if kind == "gradients" else nullcontext() as tape:
                result = function(**arguments)
            outcome.taken = True
            slopes = gradients(result, arguments.get("positions"), tape) if self.name.endswith(ARRAYS) else []
            if not all(np.isfinite(array).all() for array in (*numbers(result), *slopes)):
                outcome.problem = f"not finite: {short(result)}"
        except warpmag.InputError as error:
            if "\n" in str(error) or not 0 < len(str(error)) < 1000:
                outcome.problem = f"a message of {len(str(error))}: {error}"[:300]
        except warpmag.SimulationError:
            pass
        except BaseException as error:
            if isinstance(error, MemoryError) or not _raised_by(error, arguments):
                outcome.problem = f"{type(error).__name__}: {error}"[:200] + traceback.format_exc()[-500:]
        if outcome.taken and (parameters or number % OFTEN == 0):
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
