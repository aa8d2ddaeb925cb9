"""Magnets in the environments of Isaac Lab 3.0, on its Newton physics.

Isaac Lab replicates the prims of one environment into Newton worlds. :class:`Magnets` marks their shapes before the
model is finalized, and adds the magnetic forces in every substep, inside Isaac Lab's captured graph. It uses public
hooks only: physics events, sites, and callbacks of ``NewtonManager``.
"""

# pyright: reportAttributeAccessIssue=false
# pyright takes ``import torch`` and ``import jax`` here for the modules of these names in this folder

# pyright: reportMissingImports=false
import re
from collections.abc import Callable
from fnmatch import translate
from functools import partial
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import newton
import numpy as np
import torch
import warp as wp
from isaaclab.physics import PhysicsEvent
from isaaclab.sim import SimulationContext
from isaaclab_newton.physics import NewtonBuilderCfg, NewtonCfg, NewtonManager

from warpmag.declarations.attributes import NAMESPACE
from warpmag.declarations.checks import check_text, short_repr
from warpmag.declarations.coils import SourceRecord
from warpmag.engine.magnets.attributes import mark_shapes
from warpmag.engine.magnets.declared_magnets import add_inducible, add_permanent
from warpmag.engine.magnets.declared_sources import add_coil, checked_frame
from warpmag.engine.magnets.magnetics import Magnetics
from warpmag.engine.magnets.magnetometer import SensorMagnetometer
from warpmag.engine.magnets.usd_import import register_custom_attributes, shape_magnet
from warpmag.errors import InputError


class Magnets:
    """The magnets, coils and magnetometers of all environments.

    Create it before the environment, or in ``_setup_scene`` before assets are cloned. It exists until the environment
    is closed::

        magnets = warpmag.isaaclab.Magnets(external_field=(0.0, 0.0, 0.0))
        magnets.add_inducible(body="*/Ball_*", material="mild-steel")
        magnets.add_coil("coil", body="*/Head", shape="solenoid", radius=0.012, length=0.02)
        magnets.add_magnetometer("hall", body="*/Head", xform=((0.0, 0.0, -0.012), (0.0, 0.0, 0.0, 1.0)))
        env = MyEnv(cfg)
        magnets.set_current("coil", actions)
        observations = magnets.readings("hall")

    Prims with the schema ``WarpmagMagnetAPI`` are magnets in all environments, without a declaration.
    """

    _of_simulation: ClassVar[WeakKeyDictionary] = WeakKeyDictionary()

    def __init__(self, **settings: Any):
        """Register callbacks for physics events; ``settings`` are arguments of :class:`warpmag.Magnetics`."""
        self._settings, self._magnetics = settings, None
        self._declarations: list[Callable] = []
        self._coils: dict[str, tuple[str, dict[str, Any]]] = {}
        self._sensors: dict[str, tuple[str, dict[str, Any]]] = {}
        self._magnetometers: dict[str, SensorMagnetometer] = {}
        # no weak references: these callbacks keep the magnets alive until the physics is closed
        NewtonManager.register_callback(self._declare, PhysicsEvent.MODEL_INIT, wrap_weak_ref=False)
        NewtonManager.register_callback(self._start, PhysicsEvent.PHYSICS_READY, wrap_weak_ref=False)

    @property
    def magnetics(self) -> Magnetics:
        """Magnetics of Isaac Lab's model; raises :class:`InputError` before the physics has started."""
        if self._magnetics is None:
            raise InputError("Magnets: the physics has not started, make the environment first")
        return self._magnetics

    def add_inducible(self, **declaration: Any) -> None:
        """Make bodies or shapes inducible magnets, in all environments.

        Args:
            declaration: Arguments of :func:`warpmag.add_inducible`. ``body`` and ``shape`` are shell patterns of prim
                paths, such as ``"*/Ball_*"``. They are checked when the physics starts.
        """
        self._declarations.append(partial(add_inducible, **declaration))

    def add_permanent(self, **declaration: Any) -> None:
        """Make bodies or shapes permanent magnets, with the arguments of :func:`warpmag.add_permanent`."""
        self._declarations.append(partial(add_permanent, **declaration))

    def add_coil(self, name: str, *, body: str | None = None, xform: Any = None, **coil: Any) -> None:
        """Add a coil to bodies of all environments, before they are cloned.

        Args:
            name: Name for :meth:`set_current`, or for :meth:`set_voltage` if the coil has a resistance.
            body: Pattern of paths of bodies; None for a coil that is fixed in the frame of each environment.
            xform: Pose in the frame of the body or environment, a position and a quaternion x y z w.
            coil: Further arguments of :func:`warpmag.add_coil`.

        Raises:
            InputError: The name is used already, a value is out of range, or another coil has the same pose.
        """
        scratch = newton.ModelBuilder()
        register_custom_attributes(scratch)
        shape = add_coil(scratch, xform=xform, **coil)
        attributes = scratch.custom_attributes
        values = {key: attributes[f"{NAMESPACE}:{key}"].values[shape] for key in ("source", "strength", "voltage")}
        site = self._add_site("add_coil", name, body, scratch.shape_transform[shape])
        if any(site == other for other, _ in self._coils.values()):
            raise InputError(f"add_coil: {short_repr(name)} has the bodies and the pose of another coil")
        self._coils[name] = site, values

    def add_magnetometer(self, name: str, *, body: str | None = None, xform: Any = None, **options: Any) -> None:
        """Add a magnetometer to bodies of all environments, before they are cloned.

        Args:
            name: Name for :meth:`readings`.
            body: Pattern of paths of bodies; None for one that is fixed in the frame of each environment.
            xform: Pose in the frame of the body or environment, a position and a quaternion x y z w.
            options: ``noise``, ``saturation`` and ``seed`` of :class:`warpmag.SensorMagnetometer`.

        Raises:
            InputError: The name is used already.
        """
        frame = wp.transform() if xform is None else checked_frame("add_magnetometer: xform", xform)
        self._sensors[name] = self._add_site("add_magnetometer", name, body, frame), options

    def _add_site(self, function: str, name: str, body: str | None, frame: wp.transform) -> str:
        """Register a site, which Isaac Lab clones with its body; return the end of its label."""
        check_text(f"{function}: name", name)
        if body is not None:
            check_text(f"{function}: body", body)
        if name in self._coils or name in self._sensors:
            raise InputError(f"{function}: {short_repr(name)} exists already")
        if body is None:
            return NewtonManager.cl_register_site(None, frame, per_world=True)
        return NewtonManager.cl_register_site(translate(body), frame)

    def set_current(self, coil: str, ampere_turns: Any, env_ids: Any = None) -> None:
        """Set the current of a coil of all or some environments, on the device; captured graphs read it.

        Args:
            coil: Name of the coil.
            ampere_turns: Current times turns [A]: a number, or a tensor of shape [environments], or
                [environments, coils] where an environment has several coils of this name.
            env_ids: Environments, as a tensor or a sequence of indices; by default all.

        Raises:
            InputError: No coil has the name, it has a voltage, or the tensor has another shape.
        """
        self._set_coil("set_current", coil, ampere_turns, env_ids, driven=False)

    def set_voltage(self, coil: str, voltage: Any, env_ids: Any = None) -> None:
        """Set the voltage [V] of a coil with a resistance, with the arguments of :meth:`set_current`."""
        self._set_coil("set_voltage", coil, voltage, env_ids, driven=True)

    def _set_coil(self, function: str, coil: str, value: Any, env_ids: Any, *, driven: bool) -> None:
        attributes = getattr(self.magnetics.model, NAMESPACE)
        targets = wp.to_torch(attributes.voltage if driven else attributes.strength)
        rows = self._look_up(self._coil_shapes, function, coil)
        if (SourceRecord.from_text(self._coils[coil][1]["source"]).circuit is not None) != driven:
            raise InputError(f"{function}: {short_repr(coil)} has {'no resistance' if driven else 'a voltage'}")
        rows = rows[self._environments(function, env_ids)]
        try:
            values = torch.as_tensor(value)
            finite = values.is_cuda or bool(torch.isfinite(values).all())  # values on a GPU are not read
            values = values.to(dtype=targets.dtype, device=targets.device)
        except Exception as error:  # PyTorch raises errors of several types
            raise InputError(f"{function}: must be a number or a tensor, got {short_repr(value)}") from error
        if not finite:
            raise InputError(f"{function}: must be finite, got {short_repr(value)}")
        values = values[:, None] if values.ndim == 1 else values
        if values.ndim and tuple(values.shape) not in (tuple(rows.shape), (len(rows), 1)):
            expected = f"[{len(rows)}] or {list(rows.shape)}"
            raise InputError(f"{function}: shape must be [], {expected}, got {list(values.shape)}")
        targets[rows] = values.expand(rows.shape)

    def readings(self, magnetometer: str) -> torch.Tensor:
        """Return a view of the readings B [T] at the end of the last step, in the frames of the sensors.

        The shape is [environments, 3], or [environments, sensors, 3] where an environment has several sensors of this
        name. For environments that were reset since then call :meth:`update` first.

        Raises:
            InputError: No magnetometer has the name.
        """
        worlds = max(self.magnetics.model.world_count, 1)
        sensor = self._look_up(self._magnetometers, "readings", magnetometer)
        values = wp.to_torch(sensor.flux_density).view(worlds, -1, 3)
        return values[:, 0] if values.shape[1] == 1 else values

    def reset(self, env_ids: Any = None) -> None:
        """Reset the magnets of environments, see :meth:`warpmag.Magnetics.reset`; call it in ``_reset_idx``.

        Args:
            env_ids: Environments, as a tensor or a sequence of indices; by default all.
        """
        mask = None
        if env_ids is not None:
            model = self.magnetics.model
            mask = torch.zeros(model.world_count, dtype=torch.bool, device=wp.device_to_torch(model.device))
            mask[self._environments("reset", env_ids)] = True
        self.magnetics.reset(mask)

    def update(self) -> None:
        """Solve the induction and read the magnetometers at the present state, for example after a reset."""
        NewtonManager.forward()
        self.magnetics.induce(NewtonManager.get_state_0())
        self._measure()

    def _environments(self, function: str, env_ids: Any) -> torch.Tensor:
        """Return indices of environments, all if ``env_ids`` is None; wrong ones on the host raise an error."""
        model = self.magnetics.model
        all_ids = torch.arange(model.world_count, device=wp.device_to_torch(model.device))
        if env_ids is None:
            return all_ids
        try:
            chosen = torch.atleast_1d(all_ids[env_ids])
            (_,) = chosen.shape
        except Exception as error:  # PyTorch raises errors of several types
            raise InputError(f"{function}: env_ids: no environments: {short_repr(env_ids)}") from error
        return chosen

    @staticmethod
    def _look_up(named: dict[str, Any], function: str, name: str) -> Any:
        if not isinstance(name, str) or name not in named:
            raise InputError(f"{function}: {short_repr(name)} is unknown, there are {', '.join(named) or 'none'}")
        return named[name]

    def _declare(self, _) -> None:
        """Mark the magnets on Isaac Lab's builder, which holds all environments."""
        simulation = SimulationContext.instance()
        if not isinstance(simulation.cfg.physics, NewtonCfg):
            raise InputError("Magnets: the physics of the simulation must be Newton, a NewtonCfg")
        if self._of_simulation.setdefault(simulation, self) is not self:
            raise InputError("Magnets: the simulation has another Magnets already; declare all magnets in one")
        builder = simulation.get_or_create_backend(NewtonBuilderCfg(physics_cfg=simulation.cfg.physics))
        register_custom_attributes(builder)
        _mark_prims(builder, simulation.stage)
        for declare in self._declarations:
            declare(builder)

    def _start(self, _) -> None:
        """Make the magnetics of the finished model, and add their forces to every substep."""
        simulation, model = SimulationContext.instance(), NewtonManager.get_model()
        self._place_coils(model)
        step = simulation.cfg.dt / simulation.cfg.physics.num_substeps
        self._step, self._magnetics = step, Magnetics(model, **{"dt": step, **self._settings})
        for name, (site, options) in self._sensors.items():
            sites = self._shapes_of(model, name, site).ravel().tolist()
            self._magnetometers[name] = SensorMagnetometer(model, self._magnetics, sites, **options)
        NewtonManager.register_state_force_callback(self._apply)
        NewtonManager.unregister_post_step_callback(self._measure)  # of a start before this one
        NewtonManager.register_post_step_callback(self._measure)

    def _place_coils(self, model: newton.Model) -> None:
        """Make coils of the sites that Isaac Lab has cloned."""
        attributes = getattr(model, NAMESPACE)
        strengths, voltages = attributes.strength.numpy(), attributes.voltage.numpy()
        shapes = {name: self._shapes_of(model, name, site) for name, (site, _) in self._coils.items()}
        for name, (_, values) in self._coils.items():
            for shape in shapes[name].ravel().tolist():
                attributes.source[shape], strengths[shape] = values["source"], values["strength"]
                voltages[shape] = values["voltage"]
        attributes.strength.assign(strengths)
        attributes.voltage.assign(voltages)
        device = wp.device_to_torch(model.device)
        self._coil_shapes = {name: torch.from_numpy(rows).to(device) for name, rows in shapes.items()}

    def _shapes_of(self, model: newton.Model, name: str, site: str) -> np.ndarray:
        """Return the shapes of a site by environment, shape [environments, sites of an environment]."""
        shapes = [shape for shape, label in enumerate(model.shape_label) if label.rpartition("/")[2] == site]
        worlds = model.shape_world.numpy()[shapes]
        counts = np.bincount(worlds[worlds >= 0], minlength=max(model.world_count, 1))
        if counts.min() == 0 or (counts != counts[0]).any():
            raise InputError(f"{name}: environments have {counts.min()} to {counts.max()} of them, need equal numbers")
        return np.array(shapes)[np.argsort(worlds, kind="stable")][-counts.sum() :].reshape(len(counts), -1)

    def _apply(self, state: newton.State) -> None:
        self.magnetics.apply(state, self._step)

    def _measure(self) -> None:
        state = NewtonManager.get_state_0()
        for sensor in self._magnetometers.values():
            sensor.update(state)


def _mark_prims(builder: newton.ModelBuilder, stage: Any) -> None:
    """Mark the shapes of prims with magnetic attributes; clones without a prim follow the prim of the same name."""
    from warpmag.usd import is_source  # noqa: PLC0415 - registers schemas, after Isaac Lab has its own

    for prim in stage.Traverse():
        if is_source(prim):
            raise InputError(f"{prim.GetPath()}: coils and field maps of prims are not cloned; use Magnets.add_coil")
    magnets: dict[str, Any] = {}
    for shape, path in enumerate(builder.shape_label):
        if not path.startswith("/") or not builder.shape_flags[shape] & newton.ShapeFlags.COLLIDE_SHAPES:
            continue
        prim, name = stage.GetPrimAtPath(path), _name_in_environment(path)
        if prim:
            magnets[name] = shape_magnet(prim)
        if magnets.get(name) is not None:
            mark_shapes(builder, [shape], magnets[name])


def _name_in_environment(path: str) -> str:
    """Return the path of a prim without the number of its environment."""
    return re.sub(r"/env_\d+(?=/|$)", "/env_", path, count=1)
