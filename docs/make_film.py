"""Makes ``docs/pictures/balls_up.webp``, the film of the README: Balls Up in slow motion, drawn by Blender.

``WARPMAG_BLENDER=PYTHON python docs/make_film.py`` in a checkout. ``PYTHON`` is one with ``bpy``, as described in
``docs/pictures.md``. The pictures take about ten minutes on two cores.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

FILM = Path(__file__).parent / "pictures" / "balls_up.webp"
STEPS = (*range(0, 99, 3), *range(100, 300, 25), 300)
"""Milliseconds after the start of the scene at which pictures are drawn: first the jump, then the pile that settles."""
RATE = 12  # pictures per second
HOLD = 1500  # ms, of the last picture
SIZE, SAMPLES = (720, 405), 8  # px, paths per pixel
QUALITY = 72  # of WebP, at most 100


def simulate(folder: Path) -> Path:
    """Run the bundled scene for 0.3 s with a frame each millisecond; return the stage for renderers."""
    # bpy has its own USD library, so only the process without Blender imports these
    from pxr import Usd  # noqa: PLC0415

    import warpmag  # noqa: PLC0415
    from warpmag.scenes_usd import balls_up  # noqa: PLC0415
    from warpmag.show.export import export  # noqa: PLC0415

    scene, run, drawn = (folder / f"{name}.usdc" for name in ("scene", "run", "drawn"))
    balls_up.author(scene)
    stage = Usd.Stage.Open(str(scene))
    stage.SetTimeCodesPerSecond(1000)
    stage.SetFramesPerSecond(1000)
    stage.SetEndTimeCode(STEPS[-1])
    stage.Save()
    run = run.with_suffix(".usda")
    warpmag.Simulation(str(scene)).run(output=str(run))
    export(run, drawn, fps=1000.0)
    return drawn


def draw(stage: Path, folder: Path) -> None:
    """Draw the pictures with Blender, from a camera at rest."""
    import bpy  # noqa: PLC0415  # pyright: ignore[reportMissingImports] - Blender as a module

    sys.path.insert(0, str(Path(__file__).parents[1] / "warpmag" / "show"))
    import blender_script  # noqa: PLC0415  # pyright: ignore[reportMissingImports]

    blender_script.prepare(bpy, str(stage), STEPS[-1], SAMPLES, *SIZE)
    scene = bpy.context.scene
    for step in STEPS:
        scene.frame_set(step)
        scene.render.filepath = str(folder / f"{step:04}.png")
        bpy.ops.render.render(write_still=True)


def write(folder: Path) -> None:
    """Write the film from the pictures in a folder."""
    from PIL import Image  # noqa: PLC0415 - not in Blender's Python

    pictures = [
        Image.open(path).convert("RGB") for path in sorted(folder.glob("*.png"))
    ]
    durations = [1000 // RATE] * (len(pictures) - 1) + [HOLD]
    pictures[0].save(
        FILM,
        save_all=True,
        append_images=pictures[1:],
        duration=durations,
        loop=0,
        quality=QUALITY,
        method=6,
    )


def main() -> None:
    """Make the film; with ``--draw STAGE FOLDER`` draw the pictures only."""
    if sys.argv[1:2] == ["--draw"]:
        draw(Path(sys.argv[2]), Path(sys.argv[3]))
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stage = simulate(folder)
        python = os.environ.get("WARPMAG_BLENDER", sys.executable)
        subprocess.run(
            [python, "-P", __file__, "--draw", str(stage), str(folder)], check=True
        )
        write(folder)


if __name__ == "__main__":
    main()
