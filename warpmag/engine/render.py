"""Draws one moment of a stage by tracing rays, on a CPU too: a picture without a renderer.

The stage may be a scene or what a run wrote: bodies stand where its time samples put them. Newton's camera sensor
traces the model; of the stage it takes shapes, colours and the first camera, or looks at all bodies from above the
front where there is none.
"""

# Warp declares vectors, but not that its functions take them
# pyright: reportCallIssue=false

import math
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera

from warpmag.arrays import resolve_device
from warpmag.engine.scene import ImportedScene, import_scene
from warpmag.errors import InputError
from warpmag.usd import first_camera, open_stage, stage_clock

_SAMPLES = 4
"""Rays per pixel."""
_SKY = (206, 213, 221)
"""Colour where no ray hits, 8-bit sRGB."""
_AMBIENT = (0.45, 0.45, 0.48)
"""Linear radiance from above and below."""
_SUN = (-0.4, 0.55, -0.73)
"""Direction of the light."""
_VIEW = (0.55, -0.75, 0.4)
"""Direction from the bodies to a camera that the stage does not have."""
_FIELD_OF_VIEW = math.radians(30.0)


def render(
    stage: str | os.PathLike,
    output: str | os.PathLike,
    *,
    frame: int | None = None,
    width: int = 960,
    height: int = 540,
    device: str | None = None,
) -> None:
    """Write a PNG of a stage.

    Args:
        stage: USD file.
        output: PNG file to write.
        frame: Frame after the start, at the stage's frame rate; by default the last.
        width: Width of the picture [px].
        height: Height of the picture [px].
        device: Warp device; by default Warp's.

    Raises:
        InputError: The stage cannot be read, has no such frame, or the picture cannot be written.
    """
    if Path(output).suffix.lower() != ".png":
        raise InputError(f"{output}: a picture is written as .png")
    if min(width, height) < 1:
        raise InputError(f"size: must be positive, got {width} x {height}")
    scene = import_scene(stage, visuals=True, time_code=_time_code(stage, frame))
    with wp.ScopedDevice(resolve_device(device)):
        model = scene.builder.finalize()
        camera = SensorCamera(model, load_textures=False)
        camera.create_default_light(direction=wp.normalize(wp.vec3(*_SUN)))
        camera.set_ambient_light(_AMBIENT)
        rays, places = _view(scene, model, camera, width, height)
        color: Any = camera.allocate_image_color(1, width, height)
        config = SensorCamera.RenderConfig(enable_shadows=True, anti_aliasing=SensorCamera.AntiAliasing.SSAA)
        camera.update(model.state(), places, rays, color_image=color, render_config=config)
        pixels = color.numpy()[0].view(np.uint8).reshape(height, width, 4).astype(float)
    covered = pixels[..., 3:] / 255.0
    _write_png(Path(output), np.round(pixels[..., :3] + (1.0 - covered) * _SKY).clip(0.0, 255.0).astype(np.uint8))


def _time_code(path: str | os.PathLike, frame: int | None) -> float:
    """Return the time code of a frame."""
    clock = stage_clock(open_stage(path))
    if frame is None:
        return clock.end
    code = clock.start + frame * clock.time_codes_per_second / clock.frames_per_second
    if not clock.start <= code <= clock.end:
        last = math.floor((clock.end - clock.start) * clock.frames_per_second / clock.time_codes_per_second + 1e-9)
        raise InputError(f"frame: {path} has frames 0 to {last}, got {frame}")
    return code


def _view(scene: ImportedScene, model: newton.Model, camera: SensorCamera, width: int, height: int):
    """Return the rays in the frame of the camera, and the camera's place in the world."""
    prim = first_camera(scene.stage)
    if prim:
        rays = SensorCamera.compute_camera_rays_pinhole_usd(
            width, height, prim, sample_count=_SAMPLES, device=model.device
        )
        return rays, camera.compute_camera_transforms_usd(prim)
    field = min(_FIELD_OF_VIEW, 2.0 * math.atan(math.tan(0.5 * _FIELD_OF_VIEW) * height / width))
    rays = SensorCamera.compute_camera_rays_pinhole(
        width, height, camera_fov=field, sample_count=_SAMPLES, device=model.device
    )
    return rays, wp.array([_looking_at_bodies(model, field)], dtype=wp.transformf, device=model.device)


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


def _write_png(path: Path, pixels: np.ndarray) -> None:
    """Write 8-bit RGB pixels, shape [height, width, 3], after the PNG specification (ISO/IEC 15948)."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width, _ = pixels.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), pixels.reshape(height, -1)], axis=1)  # 0: no filter
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)), chunk(b"IEND", b"")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
