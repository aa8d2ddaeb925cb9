"""Makes the moving pictures and the page of the gallery, ``docs/gallery.md``, from the scenes and the examples.

``python docs/make_gallery.py [NAME ...]`` in a checkout with the extra ``sim``, on a CPU or a GPU. It runs each scene
and each example, or those named, and draws them by ray tracing. All take about ten minutes on two cores.
"""

import copy
import importlib
import sys
import tempfile
from pathlib import Path

import newton
import numpy as np
import warp as wp
from pxr import Sdf

import warpmag
from warpmag import examples, scenes_usd
from warpmag.show import films
from warpmag.show.ray_tracing import ModelRenderer

DOCS = Path(__file__).parent
FOLDER = DOCS / "pictures" / "gallery"
SIZE = (720, 404)  # px; a phone shows 360 points of two pixels
SCENES = {
    "alphabets": 120,
    "balls_up": 60,
    "crystal_balls": 0,
    "falling_magnet": 90,
    "sakura_tree": 100,
}
"""Scenes, and the number of frames to run; 0 for a scene at rest, which has a still."""
OPTIONS = {
    "worlds": "--world-count 5",
    "compass_swarm": "--columns 1 --rows 8",
    "sorter": "--coils 3",
}
"""Options of examples that are too large for a small picture."""
VIEWS = {
    "compass_swarm": (0.6, 0.0, 0.8),
    "levitation": (0.55, -0.75, 0.15),
    "sorter": (0.35, -0.9, 0.1),
    "trap": (0.0, 0.4, 1.0),
    "worlds": (0.3, -0.9, 0.12),
}
"""Directions from the bodies to the camera, where they are not those of the command."""
SPHERES = {
    "chain": ((0.0, 0.0, 0.0), 0.1),
    "sorter": ((0.022, 0.0, 0.008), 0.055),
}
"""Center and radius [m] of what the camera sees, where bodies leave the place in which they start."""
CAMERAS = {"falling_magnet": "auto"}
"""Cameras of scenes, where the camera of the stage cuts bodies off."""
PITCHES = {"worlds": (0.034, 0.0, 0.0), "compass_swarm": (0.0, 0.03, 0.0)}
"""Distance of neighboring worlds in pictures [m]."""
SLOW = {"levitation": 5, "worlds": 3}
NOTES = {"levitation": " (slow motion)", "worlds": " (slow motion of five worlds)"}
"""Ends of captions."""
"""Numbers of frames of examples that move for milliseconds only: a picture of each step, in slow motion."""
_RATE = 25.0  # pictures per second of slow motion
_MOST = 40
"""Largest number of pictures of an example."""
IRON, MAGNET, GROUND = (
    (0.62, 0.63, 0.65),
    (0.75, 0.06, 0.05),
    (0.62, 0.63, 0.62),
)  # sRGB


class Camera(newton.viewer.ViewerNull):
    """A viewer that keeps the pictures of the frames that it shows, with iron as metal and magnets in red."""

    pitch, view, sphere = (0.0, 0.0, 0.0), None, None
    """Distance of neighboring worlds [m], direction to the camera, and center and radius of what it sees."""

    def set_model(self, model, *args, **options):
        """Paint the magnets of a model and look at all bodies."""
        super().set_model(model, *args, **options)
        model = self._side_by_side(model)
        colors, metal = model.shape_color.numpy(), np.zeros(model.shape_count)
        kinds = model.warpmag.kind.numpy()
        colors[kinds == 1], colors[kinds == 2] = IRON, MAGNET
        metal[kinds == 1] = 1.0
        colors[model.shape_type.numpy() == int(newton.GeoType.PLANE)] = GROUND
        model.shape_color.assign(colors)
        self._renderer, self.pictures = ModelRenderer(model, SIZE, metal), []
        direction = {"direction": self.view} if self.view else {}
        if self.sphere:
            self._renderer.look_at_sphere(*self.sphere, **direction)
        else:
            self._renderer.look_at_bodies(**direction)

    def _side_by_side(self, model):
        """Return a copy of a model for drawing, whose worlds are beside each other in one world."""
        drawn = copy.copy(model)
        self._offsets = np.outer(np.maximum(model.body_world.numpy(), 0), self.pitch)
        drawn.body_q = wp.array(self._moved(model.body_q), dtype=wp.transform)
        frames, static = (
            model.shape_transform.numpy().copy(),
            model.shape_body.numpy() < 0,
        )
        frames[static, :3] += np.outer(
            np.maximum(model.shape_world.numpy()[static], 0), self.pitch
        )
        drawn.shape_transform = wp.array(frames, dtype=wp.transform)
        drawn.shape_world, drawn.bvh_shapes = wp.zeros_like(model.shape_world), None
        drawn.shape_color = wp.clone(model.shape_color)
        self._state = drawn.state()
        drawn.bvh_build_shapes(self._state)
        return drawn

    def _moved(self, poses):
        """Return poses of bodies, moved as their worlds are."""
        moved = poses.numpy().copy()
        moved[:, :3] += self._offsets
        return moved

    def log_state(self, state):
        """Keep a picture of a state."""
        self._state.body_q.assign(self._moved(state.body_q))
        self.pictures.append(self._renderer.picture(self._state))


def scene_line(name: str) -> str:
    """Return the first line of the documentation of a bundled scene."""
    layer = Sdf.Layer.FindOrOpen(str(Path(scenes_usd.__file__).parent / f"{name}.usdc"))
    line = layer.documentation.partition("\n")[0].partition(": ")[2]
    return line[0].upper() + line[1:]


def film_scene(name: str) -> None:
    """Run and draw a bundled scene."""
    film = FOLDER / f"{name}.webp"
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / f"{name}.usda"
        warpmag.Simulation(scenes_usd.bundled()[name]).run(
            SCENES[name], output=str(run)
        )
        warpmag.render(run, film, size=SIZE, camera=CAMERAS.get(name))


def film_example(name: str) -> None:
    """Run and draw an example."""
    Example = importlib.import_module(f"warpmag.examples.{name}").Example
    options = Example.create_parser().parse_args(OPTIONS.get(name, "").split())
    camera = Camera(num_frames=options.num_frames)
    camera.pitch, camera.view = PITCHES.get(name, camera.pitch), VIEWS.get(name)
    camera.sphere = SPHERES.get(name)
    rate = (_draw_steps if name in SLOW else _draw_frames)(
        Example(camera, options), SLOW.get(name, options.num_frames)
    )
    films.write(FOLDER / f"{name}.webp", camera.pictures, [], rate)


def _draw_frames(example, count: int) -> float:
    """Run frames of an example and draw some; return the pictures per second of the motion."""
    stride, times = -(-count // _MOST), []
    for frame in range(count):
        example.step()
        if frame % stride == 0:
            example.render()
            times.append(example.sim_time)
    return (len(times) - 1) / (times[-1] - times[0])


def _draw_steps(example, count: int) -> float:
    """Run frames of an example and draw each step of its simulation; return the pictures per second of the film."""
    step = example.simulation.step

    def step_and_draw() -> None:
        step()
        example.render()

    example.simulation.step = step_and_draw
    for _ in range(count):
        example.step()
    return _RATE


def picture(name: str) -> str:
    """Return the path of a film from the page, or of the finished picture of a scene without one."""
    film = FOLDER / f"{name}.webp"
    drawn = film.exists() and film.stat().st_size > 0
    return (
        (film if drawn else DOCS / "pictures" / f"{name}.jpg")
        .relative_to(DOCS)
        .as_posix()
    )


def page() -> str:
    """Return the page of the gallery."""
    head = (
        "# Gallery\n\n"
        "`docs/make_gallery.py` runs these scenes and examples and draws films by ray tracing. For two scenes this\n"
        "page shows stills [drawn by Blender](pictures.md) instead of films. [Scenes of many\n"
        "balls](howto/many_balls.md) describes the scene `million`."
        "\n\n"
    )
    entries = [(f"warpmag run {name}", scene_line(name), name) for name in SCENES]
    examples_of = [
        (
            f"python -m warpmag.examples {name}",
            line.rstrip(".") + NOTES.get(name, ""),
            name,
        )
        for name, line in examples.get_examples().items()
    ]
    sections = (("Scenes", entries), ("Examples", examples_of))
    return head + "\n".join(
        f"## {title}\n\n"
        + "\n".join(
            f"{line.rstrip('.')}:\n\n```\n{command}\n```\n\n![{line}]({picture(name)})\n"
            for command, line, name in rows
        )
        for title, rows in sections
    )


def main() -> None:
    """Make the films named on the command line, or all, and the page."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    moving = [name for name, frames in SCENES.items() if frames]
    for name in sys.argv[1:] or [*moving, *examples.get_examples()]:
        (film_scene if name in SCENES else film_example)(name)
    (DOCS / "gallery.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
