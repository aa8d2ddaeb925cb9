"""Exports of a scene or a recording: stages for renderers, web pages, and arrays of numbers."""

import csv
import os
from pathlib import Path

import numpy as np

from warpmag.declarations.checks import check_flag, check_positive, check_token, real_number, short_repr
from warpmag.deprecation import renamed_arguments
from warpmag.errors import InputError
from warpmag.show.magnet_overlays import COLORS, MagnetOverlays
from warpmag.show.renderer_stage import RendererStage
from warpmag.usd import Recording, open_animated, read_recording, usable_path
from warpmag.usd.write.output import Output

_TOP = 0.99
"""Quantile of the values at which the color scale ends, so that a few collisions do not compress the scale."""


@renamed_arguments(rate="fps")
def export(
    stage: str | os.PathLike,
    output: str | os.PathLike,
    *,
    fps: float = 24.0,
    color: str | None = None,
    arrows: bool = False,
    field_lines: int = 0,
    materialx: bool = False,
    device: str | None = None,
) -> list[str]:
    """Export a scene, or the recording of a run.

    Positions equal those of the stage bit by bit in single precision. ``.npz`` and ``.csv`` contain the recording in SI
    units and take no options. ``.html`` is one web page that plays the motion without a network, seen by a camera that
    the user moves. It shows the colors of the materials or of ``color``, but no textures.

    Args:
        stage: USD file.
        output: File to write: ``.usd``, ``.usda``, ``.usdc``, ``.usdz``, ``.html``, ``.npz`` or ``.csv``.
        fps: Frames and time codes per second [1/s]; Blender plays 24 per second, a page plays in real time.
        color: Quantity that colors the bodies: ``magnetization``, ``speed``, or ``force`` (the magnetic force between
            the moments of the frame); by default bodies have their materials.
        arrows: Draw moments as arrows.
        field_lines: Number of field lines from the permanent magnets, in the field of the moments and the external one.
        materialx: Also describe materials in MaterialX.
        device: Warp device; by default Warp's.

    Returns:
        Notes about the result, one line each.

    Raises:
        InputError: The stage cannot be read, the output cannot be written, or an argument is wrong.

    Example:
        >>> import warpmag
        >>> simulation = warpmag.Simulation("lift.usda", device="cpu")
        >>> statistics = simulation.run(2, output="run.usda")
        >>> warpmag.export("run.usda", "run_for_blender.usdc", fps=24)
        []
    """
    usable_path(stage, "stage")
    suffix = usable_path(output, "output").suffix
    check_positive("fps", fps)
    if not (isinstance(field_lines, int) and field_lines >= 0):
        raise InputError(f"field_lines: must be a whole number from 0 on, got {short_repr(field_lines)}")
    check_flag("arrows", arrows)
    check_flag("materialx", materialx)
    if color is not None:
        check_token("color", color, tuple(COLORS))
    if suffix in (".npz", ".csv"):
        _write_numbers(stage, usable_path(output))
        return []
    render, notes = RendererStage(stage, rate=real_number("fps", fps)), []
    if (color or arrows or field_lines) and not render.recording.magnets:
        raise InputError(f"{stage}: has no moments to show, since no run has written it")
    magnets = MagnetOverlays(render) if color or arrows or field_lines else None
    shades = None
    if magnets and color:
        shades, top = _shades(magnets.values(color, device))
        notes.append(f"color          {color}, from 0 to {top:.3g} {COLORS[color]}")
    render.add_bodies(shades)
    if magnets and arrows:
        render.add_arrows(*magnets.arrows())
    if magnets and field_lines:
        render.add_lines(*magnets.field_lines(field_lines, device))
    render.save(output, materialx=materialx)
    return notes


def _shades(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Return values scaled to the range from 0 to 1, and the value that becomes 1."""
    top = float(np.quantile(values, _TOP)) or 1.0
    return np.clip(values / top, 0.0, 1.0), top


def _write_numbers(stage: str | os.PathLike, path: Path) -> None:
    """Write the recording of a stage as arrays in SI units, in the world frame."""
    record = read_recording(*open_animated(stage))
    columns = {
        "positions": record.positions * record.meters_per_unit,
        "orientations": record.rotations,
        "velocities": record.linear * np.float32(record.meters_per_unit),
        "angular_velocities": record.angular,
    }
    with Output.errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".npz":
            names = {"bodies": np.array(record.bodies), "magnets": np.array(record.magnets)}
            with open(path, "wb") as file:
                np.savez_compressed(file, time=record.seconds, moments=record.moments, **names, **columns)
        else:
            _write_table(path, record, columns)


def _write_table(path: Path, record: Recording, columns: dict[str, np.ndarray]) -> None:
    """Write a row for each body, and for each magnet that is not a body, at each time."""
    moments = {name: record.moments[:, k] for k, name in enumerate(record.magnets)}
    static = [name for name in record.magnets if name not in record.bodies]
    head = "time [s],prim,x [m],y [m],z [m],qx,qy,qz,qw,vx [m/s],vy [m/s],vz [m/s],wx [rad/s],wy [rad/s],wz [rad/s]"
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow([*head.split(","), "mx [A m2]", "my [A m2]", "mz [A m2]"])
        values = np.concatenate(list(columns.values()), axis=-1)
        for frame, second in enumerate(record.seconds.tolist()):
            for row, name in enumerate(record.bodies):
                moment = moments[name][frame].tolist() if name in moments else [""] * 3
                table.writerow([second, name, *values[frame, row].tolist(), *moment])
            for name in static:
                table.writerow([second, name, *[""] * values.shape[-1], *moments[name][frame].tolist()])
