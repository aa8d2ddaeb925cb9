"""Finished pictures: exports a stage and renders it with Blender's path tracer in a child process."""

import importlib.util
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from warpmag.declarations.checks import check_count, check_whole, whole_pair
from warpmag.errors import InputError
from warpmag.show.export import export
from warpmag.usd import open_animated, stage_clock, usable_path
from warpmag.usd.write.output import Output

BLENDER = "WARPMAG_BLENDER"
"""Environment variable: a Python with ``bpy``, where this Python has none."""
_SAMPLES = 24
"""Paths per pixel; a denoiser removes the remaining noise."""
_PICTURES = (".png", ".jpg")


def render_final(
    stage: str | os.PathLike,
    output: str | os.PathLike,
    *,
    frame: int | None = None,
    size: tuple[int, int] = (1280, 720),
    samples: int = _SAMPLES,
    **overlays,
) -> Path:
    """Draw a frame of a scene, or of the recording of a run, as a finished picture.

    Args:
        stage: USD file.
        output: ``.png`` or ``.jpg`` file to write.
        frame: Frame after the start, at the stage's frame rate; by default the last.
        size: Width and height [px].
        samples: Paths per pixel.
        **overlays: ``color``, ``arrows`` and ``field_lines`` of :func:`warpmag.show.export.export`.

    Returns:
        The file written.

    Raises:
        InputError: Blender is missing or fails, or the stage cannot be read or has no such frame.
    """
    usable_path(stage, "stage")
    path, size = usable_path(output, "output"), whole_pair("size", size)
    if path.suffix not in _PICTURES:
        raise InputError(f"{path}: a finished picture must end in {' or '.join(_PICTURES)}")
    for name, value in zip(("width", "height", "samples"), (*size, samples), strict=True):
        check_count(name, value)
    python = _python()
    clock = stage_clock(open_animated(stage)[0])
    per_code = clock.frames_per_second / clock.time_codes_per_second
    last = round((clock.end - clock.start) * per_code)
    if frame is not None:
        check_whole("frame", frame)
        if not 0 <= frame <= last:
            raise InputError(f"frame: {stage} has frames 0 to {last}, got {frame}")
    code = round(clock.start * per_code) + (last if frame is None else frame)
    with tempfile.TemporaryDirectory() as folder:
        exported, drawn = Path(folder) / "stage.usdc", Path(folder) / f"picture{path.suffix}"
        export(stage, exported, fps=clock.frames_per_second, **overlays)
        script = Path(__file__).with_name("blender_script.py")
        numbers = map(str, (code, samples, *size))
        done = subprocess.run([python, "-P", script, exported, drawn, *numbers], capture_output=True, text=True)
        if not drawn.exists():
            errors = [line for line in done.stderr.splitlines() if line.strip()] or ["it wrote nothing"]
            raise InputError(f"{stage}: Blender could not draw it ({errors[-1].strip()})")
        with Output.errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(drawn.read_bytes())
    return path


def _python() -> str:
    """Return the path of a Python that has Blender."""
    if path := os.environ.get(BLENDER):
        if not os.access(path, os.X_OK):
            raise InputError(f"{BLENDER}: {path} is not a Python that can be started")
        return path
    if importlib.util.find_spec("bpy"):
        return sys.executable
    raise InputError(
        "quality: 'final' needs Blender as a Python module, pip install bpy==5.0.1, which exists for Python 3.11 only; "
        f"{BLENDER} may name another Python that has it"
    )
