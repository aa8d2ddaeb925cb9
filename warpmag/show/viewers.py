"""Shows magnets in Newton's viewers."""

import math
import time as clock

import newton
import numpy as np
import warp as wp

from warpmag.declarations.checks import real_number, short_repr
from warpmag.engine.magnets.caller_checks import check_state
from warpmag.engine.magnets.magnetics import Magnetics, check_magnetics
from warpmag.errors import InputError, extra

_DIRECTION = np.array((0.55, -0.75, 0.45))
"""Direction from the scene to the camera, along east, north and up."""
_FIELD_OF_VIEW = math.radians(45.0)
"""Field of view of the viewers' cameras."""
_COLORS = np.array([(0.27, 0.0, 0.33), (0.13, 0.57, 0.55), (0.99, 0.91, 0.14)])
"""Colors of zero, half and the largest magnetization: three colors of viridis."""
_LENGTH = 1.6
"""Half length of the longest arrow over the radius of its shape; both ends stick out of the shape."""
_PAUSE = 1.0 / 60.0
"""Interval at which the buttons of a viewer are polled while it is paused or shows the last frame [s]."""


def no_viewer(name: str, error: Exception) -> InputError:
    """Return an error of one line about a viewer that could not open."""
    reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
    if isinstance(error, ModuleNotFoundError):
        return InputError(f"viewer: {name} needs {extra('viewers')}: {reason}")
    display = ", it needs a display; viser and rerun need none" if name == "gl" else ""
    return InputError(f"viewer: {name} cannot open{display}: {reason}")


class Display:
    """A model with its magnets in one of Newton's viewers.

    Every magnetic shape has an arrow along its magnetization. The length and the color of an arrow, from violet through
    green to yellow, show its magnetization divided by the largest one in the frame. The camera of ``gl``, ``viser`` and
    ``rtx`` starts where it sees all bodies.

    Attributes:
        viewer: The viewer.
        restarted: True after the reset button was pressed, if :meth:`allow_restart` was called.

    Example:
        >>> import newton
        >>> import warpmag
        >>> simulation = warpmag.Simulation("lift.usda", device="cpu")
        >>> viewer = newton.viewer.ViewerNull()  # or ViewerGL(), ViewerViser()
        >>> display = warpmag.Display(viewer, simulation.model, simulation.magnetics)
        >>> simulation.step()
        >>> display.show(simulation.time, simulation.state)
    """

    def __init__(self, viewer, model: newton.Model, magnetics: Magnetics):
        """Set the model of the viewer.

        Args:
            viewer: A viewer of :mod:`newton.viewer`.
            model: The model.
            magnetics: The magnets of the model.
        """
        methods = (getattr(viewer, name, None) for name in ("set_model", "begin_frame", "log_state"))
        if isinstance(viewer, type) or not all(map(callable, methods)):
            raise InputError(f"viewer: must be a viewer of newton.viewer, got {short_repr(viewer)}")
        self.viewer, self.restarted = viewer, False
        self._set_model(model, magnetics)
        self.frame()

    def _set_model(self, model: newton.Model, magnetics: Magnetics) -> None:
        check_magnetics(magnetics, model)
        self._model, self._magnetics = model, magnetics
        self.viewer.set_model(model)
        shapes = magnetics.shapes
        self._bodies = model.shape_body.numpy()[shapes]
        self._frames = model.shape_transform.numpy()[shapes].astype(float)
        self._radii = model.shape_collision_radius.numpy()[shapes]
        self._worlds = model.shape_world.numpy()[shapes]

    def allow_restart(self) -> None:
        """Connect the reset button of the viewer, if it has one, to :attr:`restarted`."""
        if hasattr(self.viewer, "set_reset_callback"):
            self.viewer.set_reset_callback(lambda: setattr(self, "restarted", True))

    def restart(self, model: newton.Model, magnetics: Magnetics) -> None:
        """Replace the model by a new one; the camera stays."""
        self.restarted = False
        self._set_model(model, magnetics)

    def frame(self) -> None:
        """Place the camera where it sees all bodies of the model in their initial state, in all worlds shown."""
        centers, radii = self._bounding_balls(self._model.state())
        if not len(centers):
            return
        center = 0.5 * ((centers - radii[:, None]).min(axis=0) + (centers + radii[:, None]).max(axis=0))
        reach = float((np.linalg.norm(centers - center, axis=1) + radii).max())
        up = int(self._model.up_axis)
        east, north = (up + 1) % 3, (up + 2) % 3
        if up == 1:  # the yaw of viewers has the other sign about y
            east, north = 0, 2
        direction = _DIRECTION / np.linalg.norm(_DIRECTION)
        position = center.copy()
        position[[east, north, up]] += 1.1 * reach / math.sin(0.5 * _FIELD_OF_VIEW) * direction
        yaw = math.degrees(math.atan2(-direction[1], -direction[0]))
        self.viewer.set_camera(wp.vec3(*position), math.degrees(-math.asin(direction[2])), yaw)

    def _bounding_balls(self, state: newton.State) -> tuple[np.ndarray, np.ndarray]:
        """Return centers [m], shape [n, 3], and radii [m], shape [n], of shapes on bodies and of magnets."""
        model = self._model
        bodies, radii = model.shape_body.numpy(), model.shape_collision_radius.numpy()
        shown = (bodies >= 0) & (model.shape_flags.numpy() & int(newton.ShapeFlags.VISIBLE) != 0)
        shown[self._magnetics.shapes] = True
        shapes = np.flatnonzero(shown & (radii < 1e5))  # without infinite planes
        centers = _in_world(state, bodies[shapes], model.shape_transform.numpy()[shapes].astype(float))
        return centers + self._offsets(model.shape_world.numpy()[shapes]), radii[shapes].astype(float)

    def _offsets(self, worlds: np.ndarray) -> np.ndarray:
        """Return the offsets at which the viewer shows each of ``worlds`` [m], shape [n, 3]."""
        offsets = getattr(self.viewer, "world_offsets", None)
        if offsets is None or not len(offsets):
            return np.zeros((len(worlds), 3))
        return np.where(worlds[:, None] >= 0, offsets.numpy()[np.maximum(worlds, 0)], 0.0)

    def show(self, time: float, state: newton.State) -> None:
        """Show a state and the magnetizations of the last :meth:`Magnetics.apply`; waits for the device.

        Args:
            time: Simulated time [s].
            state: The state.
        """
        check_state(state, self._model, "body_q", "particle_q")
        self.viewer.begin_frame(real_number("time", time))
        self.viewer.log_state(state)
        if self._magnetics.is_solved and not isinstance(self.viewer, newton.viewer.ViewerNull):
            self._show_arrows(state)
        self.viewer.end_frame()

    def apply_forces(self, state: newton.State) -> None:
        """Add the viewer's forces, by which the mouse drags bodies, to ``state.body_f``; capturable in a graph.

        Call it in each substep, after :meth:`Magnetics.apply`, or give it to a simulation:
        ``Simulation(..., on_substep=lambda state, dt: display.apply_forces(state))``. Viewers without picking do
        nothing.
        """
        check_state(state, self._model, "body_q", "body_f")
        if hasattr(self.viewer, "apply_forces"):
            self.viewer.apply_forces(state)

    def follow(self, time: float, state: newton.State) -> bool:
        """Show a state, repeatedly while the viewer is paused.

        Args:
            time: Simulated time [s].
            state: The state.

        Returns:
            False if the viewer was closed or its reset button pressed, else True.
        """
        self.show(time, state)
        while self.viewer.is_running() and not self.viewer.should_step() and not self.restarted:
            clock.sleep(_PAUSE)
            self.show(time, state)
        return self.viewer.is_running() and not self.restarted

    def stay(self) -> None:
        """Keep the last frame until the viewer is closed, Ctrl-C is pressed, or the reset button is pressed."""
        try:
            while self.viewer.is_running() and not self.restarted:
                clock.sleep(_PAUSE)
                self.viewer.should_step()  # polls the buttons
        except KeyboardInterrupt:
            pass
        if not self.restarted:
            self.viewer.close()

    def _show_arrows(self, state: newton.State) -> None:
        volumes = self._magnetics.shape_volumes[:, None]
        magnetizations = self._magnetics.sum_moments().numpy() / np.where(volumes > 0.0, volumes, np.inf)
        strengths = np.linalg.norm(magnetizations, axis=1)
        largest = max(float(strengths.max(initial=0.0)), 1e-30)
        centers = _in_world(state, self._bodies, self._frames) + self._offsets(self._worlds)
        halves = _LENGTH * self._radii[:, None] * magnetizations / largest
        colors = np.stack([np.interp(strengths / largest, (0.0, 0.5, 1.0), channel) for channel in _COLORS.T], axis=1)
        arrays = (
            wp.array(np.ascontiguousarray(rows, np.float32), dtype=wp.vec3, device=self._model.device)
            for rows in (centers - halves, centers + halves, colors)
        )
        self.viewer.log_arrows("/magnetization", *arrays, width=0.1 * float(np.median(self._radii)))


def _in_world(state: newton.State, bodies: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Return the origins of frames of bodies (-1: the world) in the world [m], shape [n, 3]."""
    points = frames[:, :3]
    if state.body_q is None or not len(state.body_q):
        return points.copy()
    poses = state.body_q.numpy()[np.maximum(bodies, 0)].astype(float)
    axis, real = poses[:, 3:6], poses[:, 6:]
    rotated = points + 2.0 * np.cross(axis, np.cross(axis, points) + real * points)
    return np.where(bodies[:, None] >= 0, poses[:, :3] + rotated, points)
