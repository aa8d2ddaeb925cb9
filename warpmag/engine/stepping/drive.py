"""Lets a model follow keys while it is stepped: poses of kinematic bodies, magnetizations, currents,
the external field.

Keys lie on the device and are looked up at its time, which repeated and shortened substeps move as they must.
"""

import newton
import numpy as np
import warp as wp

from warpmag.declarations.checks import short_repr
from warpmag.declarations.keys import Keys, SceneKeys
from warpmag.engine.magnets.attributes import NAMESPACE
from warpmag.engine.magnets.magnetics import Magnetics
from warpmag.errors import InputError
from warpmag.kernels.rigid.keyed_poses import launch_place, pose_bodies
from warpmag.kernels.rigid.keys import follow, launch_follow
from warpmag.moments.arrays import host_array


class Drive:
    """What of one model follows keys; every method only launches kernels.

    Attributes:
        time: Time on the device [s], to be kept by who steps, float64, shape [1].
    """

    def __init__(self, model: newton.Model, magnetics: Magnetics, keys: SceneKeys, *, ahead: bool):
        """Put the keys on the device.

        Args:
            model: The model.
            magnetics: Its magnets.
            keys: What follows what.
            ahead: Whether the solver wants kinematic bodies where they stand at the end of its step.
        """
        self.time = wp.zeros(1, dtype=wp.float64, device=model.device)
        self._magnetics, self._ahead = magnetics, ahead
        self._bodies = None
        if keys.motions:
            operations = {body: motion.operations for body, motion in keys.motions.items()}
            self._bodies = pose_bodies(operations, _free_joints(model, list(operations)), model, self.time)
        curves, targets = [], []
        for shape, curve in keys.magnetizations.items():
            curves.append(curve)
            targets.append(getattr(model, NAMESPACE).magnetization[shape : shape + 1])
        for shape, curve in keys.currents.items():
            curves.append(curve)
            targets.append(getattr(model, NAMESPACE).strength[shape : shape + 1])
        self._field = None
        if keys.field is not None:
            self._field = wp.zeros(1, dtype=wp.vec3, device=model.device)
            curves.append(keys.field)
            targets.append(self._field)
        self._followers = follow(curves, targets, self.time) if curves else None

    def set_values(self, offset: float, *, shared: wp.array | None = None, substep: float = 0.0) -> None:
        """Set magnetizations, currents and the field to what they are some seconds after :attr:`time`.

        Args:
            offset: The seconds.
            shared: Substeps that share these values, see ``kernels.rigid.keys.launch_follow``.
            substep: Length of these [s].
        """
        if self._followers is not None:
            launch_follow(self._followers, offset, shared=shared, substep=substep)
        if self._field is not None:
            self._magnetics.set_external_field(self._field)

    def lead(self, state: newton.State, begin: float, dt: float) -> None:
        """Make kinematic bodies ready for a substep of ``dt`` [s] that begins ``begin`` [s] after :attr:`time`."""
        if self._bodies is not None:
            launch_place(self._bodies, state, begin, dt, at_end=self._ahead)

    def place(self, state: newton.State, begin: float, horizon: float) -> None:
        """Place kinematic bodies ``begin`` [s] after :attr:`time`, with the velocities of the next ``horizon`` [s].

        Contacts are sought with these.
        """
        if self._bodies is not None:
            launch_place(self._bodies, state, begin, horizon, at_end=False)


class KeyedCurrents:
    """Currents of the coils of a stage that ``builder.add_usd`` brought in with time samples, for programs that step.

    ``Simulation`` follows the keys of a stage by itself. Magnetizations and motions with keys are not among these:
    ``add_usd`` takes them where they start. Worlds that are replicas follow the same keys::

        currents = warpmag.KeyedCurrents(model)
        currents.set(0.25)
        magnetics.apply(state)

    Attributes:
        shapes: The sites that stand for the coils.
        time: Time since the start of the stage [s] on the device, float64, shape [1].
    """

    def __init__(self, model: newton.Model):
        """Put the keys on the device, and set the currents to those at the start.

        Args:
            model: A finished model.

        Raises:
            InputError: No coil of the model has keys.
        """
        texts = getattr(getattr(model, NAMESPACE, None), "current_keys", None) or ()
        found = {shape: Keys.from_text(text) for shape, text in enumerate(texts) if text}
        if not found:
            raise InputError("KeyedCurrents: no coil of the model has a current with time samples")
        self.shapes, strength = tuple(found), getattr(model, NAMESPACE).strength
        self.time = wp.zeros(1, dtype=wp.float64, device=model.device)
        self._followers = follow(
            list(found.values()), [strength[shape : shape + 1] for shape in self.shapes], self.time
        )
        self.set()

    def set(self, time: float | None = None) -> None:
        """Set the currents to what they are at a time; without one, at :attr:`time`, which a captured graph may move.

        Args:
            time: Time since the start of the stage [s].

        Raises:
            InputError: It is not finite.
        """
        if time is not None:
            seconds = host_array("time", time)
            if seconds.size != 1:
                raise InputError(f"time: must be one number, got {short_repr(time)}")
            self.time.fill_(float(seconds.reshape(-1)[0]))
        launch_follow(self._followers, 0.0)


def _free_joints(model: newton.Model, bodies: list[int]) -> list[int]:
    """Return the free joint of each body, -1 if it has none."""
    if not model.joint_count:
        return [-1] * len(bodies)
    free = np.flatnonzero(model.joint_type.numpy() == newton.JointType.FREE)
    of_body = dict(zip(model.joint_child.numpy()[free].tolist(), free.tolist(), strict=True))
    return [of_body.get(body, -1) for body in bodies]
