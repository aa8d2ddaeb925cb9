"""Draws frames of a stage by ray tracing on any device, as pictures or films, without an external renderer.

The stage may be a scene or the recording of a run: bodies stand at the poses of their time samples. Newton's camera
sensor traces the model. It uses the shapes, colors and first camera of the stage. Without a camera that sees bodies,
the view shows all bodies from the front and above.

Newton's camera returns the light that each surface scatters. A metal scatters none: it mirrors its surroundings, here a
sky that brightens towards the horizon, a ground and a sun. Fresnel's reflectance is approximated (Schlick 1994).
Reflections of other bodies are left out.
"""

# Warp declares vectors, but not that its functions take them
# pyright: reportCallIssue=false

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations.checks import check_flag, check_text, check_whole, short_repr, whole_pair
from warpmag.deprecation import renamed_arguments
from warpmag.engine.newton_versions import camera_type
from warpmag.engine.stepping.scene import ImportedScene, import_scene
from warpmag.errors import InputError
from warpmag.moments.arrays import resolve_device
from warpmag.show import films
from warpmag.show.materials import metalness
from warpmag.usd import (
    Playback,
    StageClock,
    newton_errors,
    open_deferred,
    perspective_cameras,
    quiet,
    stage_clock,
    usable_path,
)

_SAMPLES = 3
"""Rays per pixel along each of its sides."""
_VIEW = (0.55, -0.75, 0.4)
"""Direction from the bodies to the camera of a stage that has none; z is up."""
_FIELD_OF_VIEW = math.radians(30.0)
_ARROW_COLOR = (1.0, 0.55, 0.05)
_LEAST_SHOWN = 0.02
"""A magnet gets no arrow up to this fraction of the largest ratio of moment to cubed size."""
_SUN = (-0.4, 0.55, -0.73)
"""Direction of the sun's light."""
_AMBIENT = ((0.5, 0.53, 0.58), (0.22, 0.21, 0.2))
"""Linear radiance from above and from below."""
_ZENITH, _HORIZON = np.array((0.42, 0.5, 0.62)), np.array((0.80, 0.83, 0.86))
_GROUND = np.array((0.16, 0.155, 0.15))
AUTO = "auto"
"""Name of the view of all bodies, in place of a camera's."""
_LOOK = (18, 32)
"""Rows and columns of rays that find out whether a camera sees bodies."""
_HIGHLIGHT, _SHARPNESS = 4.0, 180.0
"""Radiance of the sun's reflection in a polished surface, and the exponent by which it fades (Phong 1975)."""


@renamed_arguments(moments="arrows")
def render(
    stage: str | os.PathLike,
    output: str | os.PathLike,
    *,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    size: tuple[int, int] = (960, 540),
    arrows: bool = False,
    camera: str | None = None,
    device: str | None = None,
    on_camera: Callable[[str], None] | None = None,
) -> list[Path]:
    """Draw a stage.

    Args:
        stage: USD file.
        output: ``.png`` for pictures; ``.mp4``, ``.webp`` or ``.gif`` for a film, at the stage's frame rate.
        frame: Frame after the start, at the stage's frame rate; by default the last, for a film all frames.
        frames: First and last frame of several; the name of each picture contains the number of its frame.
        size: Width and height [px].
        arrows: Draw the moments of the recording as arrows.
        camera: Prim path of a perspective camera, or ``auto`` for a view of all bodies. By default the first camera of
            the stage, or ``auto`` if that camera sees no body, or is inside a shape and sees nothing else.
        device: Warp device; by default Warp's.
        on_camera: Called with a line of text that names the camera.

    Returns:
        The files written.

    Raises:
        InputError: The stage cannot be read, has no such frames, camera or moments, the pictures cannot be written, or
            an argument has another type.

    Example:
        >>> import warpmag
        >>> warpmag.render("lift.usda", "lift.png", size=(64, 36), device="cpu")
        [PosixPath('lift.png')]
    """
    usable_path(stage, "stage")
    output, size = usable_path(output, "output"), whole_pair("size", size)
    films.check_name(output)
    if min(size) < 1 or max(size) > 2**14:
        raise InputError(f"size: must be 1 to 16384, got {size[0]} x {size[1]}")
    check_flag("arrows", arrows)
    if camera is not None:
        check_text("camera", camera)
    if not (on_camera is None or callable(on_camera)):
        raise InputError(f"on_camera: must be a function, got {short_repr(on_camera)}")
    clock = stage_clock(open_deferred(stage)[0])
    numbers, rate = _numbers(stage, clock, output, frame, frames), clock.frames_per_second
    if output.suffix.lower() in films.FILMS:
        stride = films.stride_of(output, rate)
        numbers, rate = numbers[::stride], rate / stride
    codes = [clock.start + number * clock.time_codes_per_second / clock.frames_per_second for number in numbers]
    with wp.ScopedDevice(resolve_device(device)):
        scene = import_scene(stage, visuals=True, time_code=min(codes[0], clock.end))
        renderer = _StageRenderer(scene, stage, size, arrows)
        line = renderer.choose_camera(camera)
        if on_camera is not None:
            on_camera(line)
        pictures = (renderer.picture(code) for code in codes)
        return films.write(output, pictures, numbers, rate)


def _numbers(stage, clock: StageClock, output: Path, frame: int | None, frames: tuple[int, int] | None) -> list[int]:
    """Return the numbers of the frames to draw."""
    last = math.floor((clock.end - clock.start) * clock.frames_per_second / clock.time_codes_per_second + 1e-9)
    if frames is not None:
        first, final = whole_pair("frames", frames)
    elif frame is not None:
        check_whole("frame", frame)
        first = final = frame
    else:
        return list(range(last + 1)) if output.suffix.lower() in films.FILMS else [last]
    if not 0 <= first <= final <= last:
        raise InputError(
            f"frame: {stage} has frames 0 to {last}, got {first}{'' if first == final else f' to {final}'}"
        )
    return list(range(first, final + 1))


class ModelRenderer:
    """Pictures of a Newton model, by default from a camera that sees all bodies.

    The ray tracer is :class:`newton.sensors.SensorCamera`. ::

        renderer = ModelRenderer(model, (320, 180), metal=np.zeros(model.shape_count))
        picture = renderer.picture(state)  # 8-bit sRGB, shape [180, 320, 3]
    """

    def __init__(self, model: newton.Model, size: tuple[int, int], metal: np.ndarray):
        """Look at all bodies of a model.

        Args:
            model: The model; colors are its ``shape_color``.
            size: Width and height of the pictures [px].
            metal: Metalness of each shape, 0 to 1, shape [n].

        Raises:
            InputError: The version of Newton has no ray tracer.
        """
        self._model, (self._width, self._height), self._metal = model, size, metal
        ray_tracer = camera_type()
        self._camera = camera = ray_tracer(model, load_textures=False)
        camera.create_default_light(direction=wp.normalize(wp.vec3(*_SUN)))
        camera.set_ambient_light(*_AMBIENT)
        self._config = ray_tracer.RenderConfig(enable_shadows=True)
        self._albedo = _to_linear(model.shape_color.numpy())
        self.look_at_bodies()

    def look_at_bodies(self, direction: tuple[float, float, float] = _VIEW) -> None:
        """Set a camera that sees all bodies in their initial poses, in a direction from them; z is up."""
        size = _SAMPLES * self._width, _SAMPLES * self._height
        self._view = _view_of_sphere(self._camera, *size, _sphere_of_bodies(self._model), np.array(direction))

    def look_at_sphere(self, center, radius: float, direction: tuple[float, float, float] = _VIEW) -> None:
        """Set a camera that sees a sphere, in a direction from its center; z is up."""
        size = _SAMPLES * self._width, _SAMPLES * self._height
        self._view = _view_of_sphere(self._camera, *size, (np.array(center), radius), np.array(direction))

    def look_from(self, prim) -> None:
        """Set the camera of a USD prim."""
        self._view = _view_of(prim, self._camera, _SAMPLES * self._width, _SAMPLES * self._height)

    def sees_bodies(self, state: newton.State) -> bool:
        """Return True if the view shows a body, or without bodies a shape, and something else beside it."""
        self._model.bvh_refit_shapes(state)
        all_rays, pose = self._view
        steps = [max(1, count // least) for count, least in zip(all_rays.shape[:2], _LOOK, strict=True)]
        rays = np.ascontiguousarray(all_rays[:: steps[0], :: steps[1]])
        _, _, shapes = self._trace(state, rays, wp.array([pose], dtype=wp.transformf, device=self._model.device))
        return bool(np.isin(shapes, _shown(self._model)).any()) and len(np.unique(shapes)) > 1

    def picture(self, state: newton.State) -> np.ndarray:
        """Return the picture of a state as 8-bit sRGB, shape [height, width, 3]."""
        model = self._model
        model.bvh_refit_shapes(state)
        all_rays, pose = self._view
        rotation = np.array(wp.quat_to_matrix(wp.transform_get_rotation(pose))).reshape(3, 3)
        camera_poses = wp.array([pose], dtype=wp.transformf, device=model.device)
        light, up = np.zeros((self._height, self._width, 3)), np.eye(3)[int(model.up_axis)]
        for k in range(_SAMPLES**2):
            rays = np.ascontiguousarray(all_rays[k // _SAMPLES :: _SAMPLES, k % _SAMPLES :: _SAMPLES])
            scattered, normals, shapes = self._trace(state, rays, camera_poses)
            directions = rays[..., 0, 1, :] @ rotation.T
            light += _shade(scattered, normals, directions, shapes, self._albedo, self._metal, up)
        return _to_srgb(light / _SAMPLES**2)

    def _trace(self, state, rays: np.ndarray, poses: wp.array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return scattered light, normals and shapes (-1 where a ray hits none), shape [height, width, ...]."""
        camera, shape = self._camera, (1, rays.shape[1], rays.shape[0])
        light: Any = camera.allocate_image_color_hdr(*shape)
        normals: Any = camera.allocate_image_normal(*shape)
        shapes: Any = camera.allocate_image_shape_index(*shape)
        images = {"hdr_color_image": light, "normal_image": normals, "shape_index_image": shapes}
        directions = wp.array(rays, dtype=wp.vec3f, device=self._model.device)
        camera.update(state, poses, directions, **images, render_config=self._config)
        hits = shapes.numpy()[0].astype(np.int64)
        return light.numpy()[0], normals.numpy()[0], np.where(hits < self._model.shape_count, hits, -1)


class _StageRenderer:
    """A stage, imported from ``path`` with its visual shapes, and a camera for pictures of ``size`` [px]."""

    def __init__(self, scene: ImportedScene, path, size: tuple[int, int], arrows: bool):
        self._scene, self._motion = scene, Playback(scene.stage, scene.swarms)
        self._arrows = _Arrows(scene, path) if arrows else None
        with newton_errors(str(path), "use"):
            self._model = model = scene.builder.finalize()
        self._state = model.state()
        self._bodies = list(scene.bodies)
        self._rows = np.array([scene.bodies[prim] for prim in self._bodies], dtype=int)
        self._renderer = ModelRenderer(model, size, self._metalness())

    def _metalness(self) -> np.ndarray:
        """Return the metalness of the materials of all shapes, shape [n]."""
        scene, labels = self._scene, self._model.shape_label
        sources = {
            label: prim
            for swarm in scene.swarms
            for prim, copies in swarm.copies_of(labels).items()
            for label in copies
        }
        with quiet():
            metal = {label: metalness(scene.stage, label) for label in labels if label not in sources}
        return np.array([metal[sources.get(label, label)] for label in labels])

    def choose_camera(self, name: str | None) -> str:
        """Set the camera of all pictures, see :func:`render`; return a line of text that names it."""
        prim = None if name == AUTO else _camera_prim(self._scene.stage, name)
        if prim:
            self._renderer.look_from(prim)
            if name or self._renderer.sees_bodies(self._state):
                return f"camera {prim.GetPath()}"
        self._renderer.look_at_bodies()
        return f"all bodies, as the camera {prim.GetPath()} sees none or one from inside" if prim else "all bodies"

    def picture(self, time_code: float) -> np.ndarray:
        """Return the picture at a time code as 8-bit sRGB, shape [height, width, 3]."""
        self._motion.seek(time_code)
        poses = self._model.body_q.numpy()
        poses[self._rows] = self._motion.poses(self._bodies)
        self._state.body_q.assign(poses)
        if self._arrows:
            self._arrows.place(self._model, poses, self._motion)
        return self._renderer.picture(self._state)


class _Arrows:
    """Cones on magnets along their moments, in the builder of a scene. A scene without moments raises an error."""

    def __init__(self, scene: ImportedScene, path):
        self._prims = list(scene.magnet_shapes)
        if not Playback(scene.stage, scene.swarms).moments(self._prims).any():
            raise InputError(f"{path}: holds no moments to show; a run writes them")
        builder = scene.builder
        self._shapes = [scene.magnet_shapes[prim][0] for prim in self._prims]
        self._sizes = np.array([builder.shape_collision_radius[shape] for shape in self._shapes])
        config = newton.ModelBuilder.ShapeConfig(density=0.0, has_shape_collision=False, has_particle_collision=False)
        self._cones = [
            builder.add_shape_cone(-1, radius=0.3 * size, half_height=0.4 * size, cfg=config, color=_ARROW_COLOR)
            for size in self._sizes
        ]

    def place(self, model: newton.Model, poses: np.ndarray, motion: Playback) -> None:
        """Place the cones on the magnets, hidden inside magnets that are too weak to show."""
        moments, frames = motion.moments(self._prims), model.shape_transform.numpy()
        lengths = np.linalg.norm(moments, axis=1)
        strengths = lengths / self._sizes**3
        bodies = model.shape_body.numpy()[self._shapes]
        for row, (cone, shape, body) in enumerate(zip(self._cones, self._shapes, bodies, strict=True)):
            frame = wp.transform(*frames[shape])
            center = (wp.transform(*poses[body]) * frame if body >= 0 else frame).p
            if strengths[row] <= _LEAST_SHOWN * strengths.max():
                frames[cone, :3] = center
                continue
            axis = wp.vec3(*(moments[row] / lengths[row]).tolist())
            tip = center + 1.4 * float(self._sizes[row]) * axis
            frames[cone] = [*tip, *wp.quat_between_vectors(wp.vec3(0.0, 0.0, 1.0), axis)]
        model.shape_transform.assign(frames)


def _camera_prim(stage, name: str | None):
    """Return the camera of a prim path, by default the first of the stage, or None without one."""
    cameras = perspective_cameras(stage)
    matching = [prim for prim in cameras if name in (None, str(prim.GetPath()))]
    if matching or name is None:
        return next(iter(matching), None)
    known = ", ".join([AUTO, *(str(prim.GetPath()) for prim in cameras)])
    raise InputError(f"camera: {short_repr(name)} is no perspective camera of the stage; there are {known}")


def _view_of(prim, camera: Any, width: int, height: int) -> tuple[Any, Any]:
    """Return the rays in the frame of a camera, shape [height, width, 1, 2, 3], and the pose of the camera.

    A camera whose lens or transform cannot be read raises :class:`InputError`.
    """
    with newton_errors(str(prim.GetPath()), "look from"):
        rays: Any = camera.compute_camera_rays_pinhole_usd(width, height, prim, device="cpu")
        return rays.numpy(), wp.transform(*camera.compute_camera_transforms_usd(prim).numpy()[0])


def _view_of_sphere(
    camera: Any, width: int, height: int, sphere: tuple[np.ndarray, float], direction: np.ndarray
) -> tuple[Any, Any]:
    """Return :func:`_view_of` a camera that sees a sphere (center, radius [m]), in a direction from it."""
    field = min(_FIELD_OF_VIEW, 2.0 * math.atan(math.tan(0.5 * _FIELD_OF_VIEW) * height / width))
    rays = camera.compute_camera_rays_pinhole(width, height, camera_fov=field, device="cpu")
    return rays.numpy(), _looking_at_sphere(*sphere, field, direction)


def _shown(model: newton.Model) -> np.ndarray:
    """Return the indices of all shapes of bodies, or of all shapes without any."""
    shape_body = model.shape_body.numpy()
    return np.flatnonzero(shape_body >= 0) if (shape_body >= 0).any() else np.arange(model.shape_count)


def _sphere_of_bodies(model: newton.Model) -> tuple[np.ndarray, float]:
    """Return center and radius [m] of a sphere that holds all shapes of bodies, or all shapes without any."""
    shape_body, poses = model.shape_body.numpy(), model.body_q.numpy()
    frames, radii = model.shape_transform.numpy(), model.shape_collision_radius.numpy()
    shown = _shown(model)
    centers = np.zeros((len(shown), 3))
    for row, shape in enumerate(shown):
        origin, body = wp.vec3(*frames[shape, :3]), shape_body[shape]
        centers[row] = wp.transform_point(wp.transform(*poses[body]), origin) if body >= 0 else origin
    low, high = (sign * (sign * centers + radii[shown, None]).max(axis=0) for sign in (-1.0, 1.0))
    return 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))


def _looking_at_sphere(center: np.ndarray, radius: float, field: float, direction: np.ndarray) -> wp.transform:
    """Return a camera pose that sees a sphere in a view of ``field`` [rad]."""
    back = direction / np.linalg.norm(direction)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back], axis=1)  # the camera looks along its -z, y is up
    eye = center + radius / math.sin(0.5 * field) * back
    return wp.transform(wp.vec3(*eye), wp.quat_from_matrix(wp.mat33(*axes.ravel().tolist())))


# ---------- Light and color ----------


def _shade(scattered: np.ndarray, normals: np.ndarray, rays: np.ndarray, shapes, albedo, metal, up) -> np.ndarray:
    """Return the linear radiance of each ray, shape [..., 3].

    ``scattered`` is the radiance of the surfaces as if they were matte; ``rays`` are unit directions, shape [..., 3].
    ``shapes`` are indices of the shapes hit, or -1; ``albedo`` and ``metal`` are linear color and metalness by shape.
    """
    radiance = np.where((shapes < 0)[..., None], _surroundings(np.maximum(rays @ up, 0.0)), scattered)
    polished = np.flatnonzero((shapes.ravel() >= 0) & (metal[shapes.ravel()] > 0.0))
    if len(polished):
        ray, normal = (values.reshape(-1, 3)[polished] for values in (rays, normals))
        shape, flat = shapes.ravel()[polished], radiance.reshape(-1, 3)
        facing = np.clip(-np.sum(ray * normal, axis=1, keepdims=True), 0.0, 1.0)
        mirrored = ray + 2.0 * facing * normal
        seen = _surroundings(mirrored @ up)
        towards = np.clip(-mirrored @ (np.array(_SUN) / np.linalg.norm(_SUN)), 0.0, 1.0)[:, None]
        lit = scattered.reshape(-1, 3)[polished] / np.maximum(albedo[shape], 1e-3)  # shadows darken reflections, too
        seen = seen * np.clip(lit / np.array(_AMBIENT[0]), 0.35, 1.0) + _HIGHLIGHT * towards**_SHARPNESS
        reflectance = albedo[shape] + (1.0 - albedo[shape]) * (1.0 - facing) ** 5
        weight = metal[shape][:, None]
        flat[polished] = (1.0 - weight) * flat[polished] + weight * reflectance * seen
    return radiance


def _surroundings(height: np.ndarray) -> np.ndarray:
    """Return the radiance of the surroundings, shape [..., 3], in directions whose upward component is ``height``."""
    height = height[..., None]
    sky = _HORIZON + (_ZENITH - _HORIZON) * np.sqrt(np.clip(height, 0.0, 1.0))
    ground = _HORIZON + (_GROUND - _HORIZON) * np.clip(-6.0 * height, 0.0, 1.0)
    return np.where(height >= 0.0, sky, ground)


def _to_srgb(linear: np.ndarray) -> np.ndarray:
    """Return 8-bit sRGB of linear values (IEC 61966-2-1)."""
    value = np.clip(linear, 0.0, 1.0)
    curved = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1.0 / 2.4) - 0.055)
    return np.round(255.0 * curved).astype(np.uint8)


def _to_linear(srgb: np.ndarray) -> np.ndarray:
    """Return linear values of sRGB in 0 to 1 (IEC 61966-2-1)."""
    value = np.asarray(srgb, dtype=float)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
