"""Draws moments of a stage by tracing rays, on a CPU too: pictures and films without a renderer.

The stage may be a scene or what a run wrote: bodies stand where its time samples put them. Newton's camera sensor
traces the model; of the stage it takes shapes, colours and the first camera, or looks at all bodies from above the
front where there is none.
"""

# Warp declares vectors, but not that its functions take them
# pyright: reportCallIssue=false

import math
import os
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera

from warpmag.engine.stepping.scene import ImportedScene, import_scene
from warpmag.errors import InputError
from warpmag.moments.arrays import resolve_device
from warpmag.show import pictures
from warpmag.show.looks import metalness
from warpmag.show.shading import AMBIENT, SUN, shade, to_linear, to_srgb
from warpmag.usd import Playback, StageClock, first_camera, open_apart, stage_clock

_SAMPLES = 3
"""Rays per pixel, along each of its sides."""
_VIEW = (0.55, -0.75, 0.4)
"""Direction from the bodies to a camera that the stage does not have, where z is up."""
_FIELD_OF_VIEW = math.radians(30.0)
_ARROW_COLOR = (1.0, 0.55, 0.05)
_LEAST_SHOWN = 0.02
"""Magnets of less moment over size cubed than this part of the strongest get no arrow."""


def render(
    stage: str | os.PathLike,
    output: str | os.PathLike,
    *,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    size: tuple[int, int] = (960, 540),
    moments: bool = False,
    device: str | None = None,
) -> list[Path]:
    """Draw a stage.

    Args:
        stage: USD file.
        output: ``.png`` for pictures; ``.mp4`` or ``.gif`` for a film, at the stage's frame rate.
        frame: Frame after the start, at the stage's frame rate; by default the last, and all of a film.
        frames: First and last frame of several, of which each picture gets its number into the name.
        size: Width and height [px].
        moments: Whether arrows show the moments that are written on the stage.
        device: Warp device; by default Warp's.

    Returns:
        The files written.

    Raises:
        InputError: The stage cannot be read, has no such frames or no moments, or the pictures cannot be written.
    """
    output = Path(output)
    pictures.check_name(output)
    if min(size) < 1 or max(size) > 2**14:
        raise InputError(f"size: must be 1 to 16384, got {size[0]} x {size[1]}")
    clock = stage_clock(open_apart(stage)[0])
    numbers = _numbers(stage, clock, output, frame, frames)
    codes = [clock.start + number * clock.time_codes_per_second / clock.frames_per_second for number in numbers]
    with wp.ScopedDevice(resolve_device(device)):
        scene = import_scene(stage, visuals=True, time_code=min(codes[0], clock.end))
        studio = _Studio(scene, stage, size, moments)
        made = (studio.picture(code) for code in codes)
        return pictures.write(output, made, numbers, clock.frames_per_second)


def _numbers(stage, clock: StageClock, output: Path, frame: int | None, frames: tuple[int, int] | None) -> list[int]:
    """Return the numbers of the frames that are wanted."""
    last = math.floor((clock.end - clock.start) * clock.frames_per_second / clock.time_codes_per_second + 1e-9)
    if frames is None and frame is None:
        return list(range(last + 1)) if output.suffix.lower() in pictures.FILMS else [last]
    first, final = frames or (frame or 0, frame or 0)
    if not 0 <= first <= final <= last:
        raise InputError(
            f"frame: {stage} has frames 0 to {last}, got {first}{'' if first == final else f' to {final}'}"
        )
    return list(range(first, final + 1))


class _Studio:
    """A stage before a camera.

    Args:
        scene: The stage, imported with what is only seen.
        path: Its file.
        size: Width and height of the pictures [px].
        moments: Whether arrows show moments.
    """

    def __init__(self, scene: ImportedScene, path, size: tuple[int, int], moments: bool):
        self._scene, self._motion, (self._width, self._height) = scene, Playback(scene.stage, scene.swarms), size
        self._arrows = _Arrows(scene, path) if moments else None
        self._model = model = scene.builder.finalize()
        self._state = model.state()
        self._camera = camera = SensorCamera(model, load_textures=False)
        camera.create_default_light(direction=wp.normalize(wp.vec3(*SUN)))
        camera.set_ambient_light(*AMBIENT)
        self._config = SensorCamera.RenderConfig(enable_shadows=True)
        self._bodies = list(scene.bodies)
        self._rows = np.array([scene.bodies[prim] for prim in self._bodies], dtype=int)
        self._albedo = to_linear(model.shape_color.numpy())
        like = {
            one: prim for swarm in scene.swarms for prim, own in swarm.like(model.shape_label).items() for one in own
        }
        metal = {label: metalness(scene.stage, label) for label in model.shape_label if label not in like}
        self._metal = np.array([metal[like.get(label, label)] for label in model.shape_label])
        self._view = _view(scene, model, camera, _SAMPLES * self._width, _SAMPLES * self._height)

    def picture(self, time_code: float) -> np.ndarray:
        """Return a moment as 8-bit sRGB, shape [height, width, 3]."""
        model, state = self._model, self._state
        self._motion.seek(time_code)
        poses = model.body_q.numpy()
        poses[self._rows] = self._motion.poses(self._bodies)
        state.body_q.assign(poses)
        if self._arrows:
            self._arrows.place(model, poses, self._motion)
        model.bvh_refit_shapes(state)
        all_rays, place = self._view
        turn = np.array(wp.quat_to_matrix(wp.transform_get_rotation(place))).reshape(3, 3)
        places = wp.array([place], dtype=wp.transformf, device=model.device)
        light = np.zeros((self._height, self._width, 3))
        for k in range(_SAMPLES**2):
            rays = np.ascontiguousarray(all_rays[k // _SAMPLES :: _SAMPLES, k % _SAMPLES :: _SAMPLES])
            scattered, normals, shapes = self._traced(rays, places)
            light += shade(
                scattered, normals, rays[..., 0, 1, :] @ turn.T, shapes, self._albedo, self._metal, _up(model)
            )
        return to_srgb(light / _SAMPLES**2)

    def _traced(self, rays: np.ndarray, places: wp.array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return scattered light, normals and shapes (-1: none) of rays, shape [height, width, ...]."""
        camera, shape = self._camera, (1, self._width, self._height)
        light: Any = camera.allocate_image_color_hdr(*shape)
        normals: Any = camera.allocate_image_normal(*shape)
        shapes: Any = camera.allocate_image_shape_index(*shape)
        camera.update(
            self._state,
            places,
            wp.array(rays, dtype=wp.vec3f, device=self._model.device),
            hdr_color_image=light,
            normal_image=normals,
            shape_index_image=shapes,
            render_config=self._config,
        )
        found = shapes.numpy()[0].astype(np.int64)
        return light.numpy()[0], normals.numpy()[0], np.where(found < self._model.shape_count, found, -1)


class _Arrows:
    """Cones on magnets, which point where their moments do.

    Args:
        scene: The stage; its builder gets the cones.
        path: Its file.

    Raises:
        InputError: The stage holds no moments.
    """

    def __init__(self, scene: ImportedScene, path):
        self._prims = list(scene.magnet_shapes)
        if not Playback(scene.stage, scene.swarms).moments(self._prims).any():
            raise InputError(f"{path}: holds no moments to show; a run writes them")
        builder = scene.builder
        self._holders = [scene.magnet_shapes[prim][0] for prim in self._prims]
        self._sizes = np.array([builder.shape_collision_radius[shape] for shape in self._holders])
        looks = newton.ModelBuilder.ShapeConfig(density=0.0, has_shape_collision=False, has_particle_collision=False)
        self._cones = [
            builder.add_shape_cone(-1, radius=0.3 * size, half_height=0.4 * size, cfg=looks, color=_ARROW_COLOR)
            for size in self._sizes
        ]

    def place(self, model: newton.Model, poses: np.ndarray, motion: Playback) -> None:
        """Put the cones onto the magnets, into those that are too weak to show."""
        moments, frames = motion.moments(self._prims), model.shape_transform.numpy()
        lengths = np.linalg.norm(moments, axis=1)
        strengths = lengths / self._sizes**3
        body = model.shape_body.numpy()[self._holders]
        for row, (cone, holder) in enumerate(zip(self._cones, self._holders, strict=True)):
            frame = wp.transform(*frames[holder])
            center = (wp.transform(*poses[body[row]]) * frame if body[row] >= 0 else frame).p
            if strengths[row] <= _LEAST_SHOWN * strengths.max():
                frames[cone, :3] = center
                continue
            axis = wp.vec3(*(moments[row] / lengths[row]).tolist())
            frames[cone] = [
                *(center + 1.4 * float(self._sizes[row]) * axis),
                *wp.quat_between_vectors(wp.vec3(0.0, 0.0, 1.0), axis),
            ]
        model.shape_transform.assign(frames)


def _up(model: newton.Model) -> np.ndarray:
    return np.eye(3)[int(model.up_axis)]


def _view(scene: ImportedScene, model: newton.Model, camera: SensorCamera, width: int, height: int) -> tuple[Any, Any]:
    """Return the rays in the frame of the camera, shape [height, width, 1, 2, 3], and the camera's place."""
    prim = first_camera(scene.stage)
    if prim:
        rays: Any = SensorCamera.compute_camera_rays_pinhole_usd(width, height, prim, device="cpu")
        return rays.numpy(), wp.transform(*camera.compute_camera_transforms_usd(prim).numpy()[0])
    field = min(_FIELD_OF_VIEW, 2.0 * math.atan(math.tan(0.5 * _FIELD_OF_VIEW) * height / width))
    rays = SensorCamera.compute_camera_rays_pinhole(width, height, camera_fov=field, device="cpu")
    return rays.numpy(), _looking_at_bodies(model, field)


def _looking_at_bodies(model: newton.Model, field: float) -> wp.transform:
    """Return a place from which a view of ``field`` [rad] holds the shapes of all bodies, or all shapes without any."""
    shape_body, poses = model.shape_body.numpy(), model.body_q.numpy()
    frames, radii = model.shape_transform.numpy(), model.shape_collision_radius.numpy()
    shown = np.flatnonzero(shape_body >= 0) if (shape_body >= 0).any() else np.arange(model.shape_count)
    places = np.zeros((len(shown), 3))
    for row, shape in enumerate(shown):
        place = wp.vec3(*frames[shape, :3])
        body = shape_body[shape]
        places[row] = wp.transform_point(wp.transform(*poses[body]), place) if body >= 0 else place
    low, high = (sign * (sign * places + radii[shown, None]).max(axis=0) for sign in (-1.0, 1.0))
    center, extent = 0.5 * (low + high), 0.5 * np.linalg.norm(high - low)
    back = np.array(_VIEW) / np.linalg.norm(_VIEW)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back], axis=1)  # the camera looks along its -z, y is up
    place = center + extent / math.sin(0.5 * field) * back
    return wp.transform(wp.vec3(*place), wp.quat_from_matrix(wp.mat33(*axes.ravel().tolist())))
