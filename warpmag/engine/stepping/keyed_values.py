"""Sets keyed values of a model: poses of kinematic bodies, magnetizations, currents, voltages, the
external field.

Keys are interpolated at a time stored on the device, so that repeated and shortened substeps read the right values.
"""

import newton
import numpy as np
import warp as wp

from warpmag.declarations.checks import short_repr
from warpmag.declarations.coils import SourceRecord
from warpmag.declarations.keys import Keys, SceneKeys
from warpmag.engine.magnets.attributes import NAMESPACE
from warpmag.engine.magnets.caller_checks import held_by_model
from warpmag.engine.magnets.magnetics import Magnetics
from warpmag.errors import InputError
from warpmag.kernels.rigid.keyed_poses import keyed_poses, write_keyed_poses
from warpmag.kernels.rigid.keys import keyed_arrays, write_keyed_values
from warpmag.moments.arrays import host_array


class KeyedModelValues:
    """Sets the keyed values of one model. Every method only launches kernels.

    The stepper sets ``time`` [s] on the device, float64, shape [1].
    """

    def __init__(self, model: newton.Model, magnetics: Magnetics, keys: SceneKeys, *, contacts_at_end: bool):
        """Copy the keys of bodies and shapes to the device.

        ``contacts_at_end`` means that the solver needs kinematic bodies at their poses at the end of a substep.
        """
        self.time = wp.zeros(1, dtype=wp.float64, device=model.device)
        self._magnetics, self._contacts_at_end = magnetics, contacts_at_end
        self._bodies = None
        if keys.motions:
            operations = {body: motion.operations for body, motion in keys.motions.items()}
            self._bodies = keyed_poses(operations, _free_joints(model, list(operations)), model, self.time)
        attributes = getattr(model, NAMESPACE)
        curves = [*keys.magnetizations.values(), *keys.currents.values(), *keys.voltages.values()]
        targets = [attributes.magnetization[shape : shape + 1] for shape in keys.magnetizations]
        targets += [attributes.strength[shape : shape + 1] for shape in keys.currents]
        targets += [attributes.voltage[shape : shape + 1] for shape in keys.voltages]
        self._field = None
        if keys.field is not None:
            self._field = wp.zeros(1, dtype=wp.vec3, device=model.device)
            curves, targets = [*curves, keys.field], [*targets, self._field]
        self._keyed = keyed_arrays(curves, targets, self.time) if curves else None

    def set_values(self, offset: float, *, shared: wp.array | None = None, substep: float = 0.0) -> None:
        """Set magnetizations, currents, voltages and the field to their values ``offset`` [s] after :attr:`time`.

        ``shared`` is the number of substeps of ``substep`` [s] that share these values (``kernels.rigid.keys``).
        """
        if self._keyed is not None:
            write_keyed_values(self._keyed, offset, shared=shared, substep=substep)
        if self._field is not None:
            self._magnetics.set_external_field(self._field)

    def pose_for_solver(self, state: newton.State, begin: float, dt: float) -> None:
        """Pose kinematic bodies for a substep of ``dt`` [s] that begins ``begin`` [s] after :attr:`time`."""
        if self._bodies is not None:
            write_keyed_poses(self._bodies, state, begin, dt, at_end=self._contacts_at_end)

    def pose_for_contacts(self, state: newton.State, begin: float, horizon: float) -> None:
        """Pose kinematic bodies for the contact search ``begin`` [s] after :attr:`time`.

        Their velocities are means over the next ``horizon`` [s].
        """
        if self._bodies is not None:
            write_keyed_poses(self._bodies, state, begin, horizon, at_end=False)


class KeyedCurrents:
    """Time-sampled currents of coils that ``builder.add_usd`` imported, for programs with a loop of their own.

    Coils with a resistance have time-sampled voltages in place of currents.

    ``Simulation`` applies the time samples of a stage itself. This class applies only those of coils: ``add_usd``
    imports poses and magnetizations at the start of the stage, without their time samples. Replicated worlds share the
    time samples.

    Attributes:
        shapes: Shape indices of the coils with time samples.
        time: Time since the start of the stage [s], on the device, float64, shape [1].

    Example:
        >>> import newton
        >>> import warpmag
        >>> import warpmag.usd  # registers the schemas
        >>> from pxr import Usd
        >>> stage = Usd.Stage.CreateInMemory()  # 24 time codes a second
        >>> coil = stage.DefinePrim("/Coil", "Xform")
        >>> marked = coil.AddAppliedSchema("WarpmagCoilAPI")
        >>> marked = coil.GetAttribute("warpmag:coil:radius").Set(0.01)
        >>> current = coil.GetAttribute("warpmag:coil:ampereTurns")
        >>> marked = current.Set(0.0, 0.0) and current.Set(100.0, 24.0)  # A·turns at a time code
        >>> builder = newton.ModelBuilder()
        >>> warpmag.register_custom_attributes(builder)
        >>> imported = builder.add_usd(stage)
        >>> model = builder.finalize(device="cpu")
        >>> currents = warpmag.KeyedCurrents(model)
        >>> currents.set(0.25)  # s after the start of the stage
        >>> float(model.warpmag.strength.numpy()[currents.shapes[0]])
        25.0
    """

    def __init__(self, model: newton.Model):
        """Copy the time samples to the device, and set the currents at the start.

        Args:
            model: A finalized model.

        Raises:
            InputError: No coil of the model has time samples.
        """
        held_by_model(model)
        texts = getattr(getattr(model, NAMESPACE, None), "current_keys", None) or ()
        keys = {shape: Keys.from_text(text) for shape, text in enumerate(texts) if text}
        if not keys:
            raise InputError("KeyedCurrents: no coil of the model has a current with time samples")
        self.shapes, attributes = tuple(keys), getattr(model, NAMESPACE)
        self.time = wp.zeros(1, dtype=wp.float64, device=model.device)
        targets = []
        for shape in self.shapes:
            driven = SourceRecord.from_text(attributes.source[shape]).circuit is not None
            targets.append((attributes.voltage if driven else attributes.strength)[shape : shape + 1])
        self._keyed = keyed_arrays(list(keys.values()), targets, self.time)
        self.set()

    def set(self, time: float | None = None) -> None:
        """Set the currents at a time; capturable in a graph if ``time`` is None.

        Args:
            time: Time since the start of the stage [s]. None stands for :attr:`time`, which a graph may advance.

        Raises:
            InputError: The time is not a finite number.
        """
        if time is not None:
            seconds = host_array("time", time)
            if seconds.size != 1:
                raise InputError(f"time: must be one number, got {short_repr(time)}")
            self.time.fill_(float(seconds.reshape(-1)[0]))
        write_keyed_values(self._keyed, 0.0)


def _free_joints(model: newton.Model, bodies: list[int]) -> list[int]:
    """Return the index of each body's free joint, -1 without one."""
    if not model.joint_count:
        return [-1] * len(bodies)
    free = np.flatnonzero(model.joint_type.numpy() == newton.JointType.FREE)
    joint_of_body = dict(zip(model.joint_child.numpy()[free].tolist(), free.tolist(), strict=True))
    return [joint_of_body.get(body, -1) for body in bodies]
