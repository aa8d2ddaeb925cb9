"""Finished pictures: a stage is exported and drawn by Blender's path tracer, in a process of its own."""

import importlib.util
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from warpmag.declarations.checks import check_count
from warpmag.errors import InputError
from warpmag.show.export import export
from warpmag.usd import open_motion, stage_clock, usable_path

BLENDER = "WARPMAG_BLENDER"
"""The variable that names a Python with ``bpy``, if this one has none."""
_SAMPLES = 24
"""Paths per pixel; the rest is denoised."""
_PICTURES = (".png", ".jpg")


def render_final(
    stage: str | os.PathLike,
    output: str | os.PathLike,
    *,
    frame: int | None = None,
    size: tuple[int, int] = (1280, 720),
    samples: int = _SAMPLES,
    **shown,
) -> Path:
    """Draw a frame of a scene, or of what a run wrote, as a finished picture.

    Args:
        stage: USD file.
        output: ``.png`` or ``.jpg`` file to write.
        frame: Frame after the start, at the stage's frame rate; by default the last.
        size: Width and height [px].
        samples: Paths per pixel.
        **shown: What to show besides the bodies: ``color``, ``arrows`` and ``field_lines`` of
            :func:`warpmag.show.export.export`.

    Returns:
        The file written.

    Raises:
        InputError: There is no Blender, the stage cannot be read or has no such frame, or Blender could not draw it.
    """
    path = usable_path(output)
    if path.suffix not in _PICTURES:
        raise InputError(f"{path}: a finished picture must end in {' or '.join(_PICTURES)}")
    for name, value in zip(("width", "height", "samples"), (*size, samples), strict=True):
        check_count(name, value)
    python = _python()
    clock = stage_clock(open_motion(stage)[0])
    per_code = clock.frames_per_second / clock.time_codes_per_second
    last = round((clock.end - clock.start) * per_code)
    if frame is not None and not 0 <= frame <= last:
        raise InputError(f"frame: {stage} has frames 0 to {last}, got {frame}")
    code = round(clock.start * per_code) + (last if frame is None else frame)
    with tempfile.TemporaryDirectory() as folder:
        exported, drawn = Path(folder) / "stage.usdc", Path(folder) / f"picture{path.suffix}"
        export(stage, exported, rate=clock.frames_per_second, **shown)
        script = Path(__file__).with_name("blender.py")
        numbers = map(str, (code, samples, *size))
        done = subprocess.run([python, "-P", script, exported, drawn, *numbers], capture_output=True, text=True)
        if not drawn.exists():
            said = [line for line in done.stderr.splitlines() if line.strip()] or ["it wrote nothing"]
            raise InputError(f"{stage}: Blender could not draw it ({said[-1].strip()})")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(drawn.read_bytes())
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return path


def _python() -> str:
    """Return a Python that has Blender."""
    if named := os.environ.get(BLENDER):
        if not os.access(named, os.X_OK):
            raise InputError(f"{BLENDER}: {named} is no Python that can be started")
        return named
    if importlib.util.find_spec("bpy"):
        return sys.executable
    raise InputError(
        "quality: 'final' needs Blender as a Python module, pip install bpy==5.0.1 with Python 3.11, which alone it is "
        f"built for; name another Python that has it in {BLENDER}"
    )
