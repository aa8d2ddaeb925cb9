"""Magnetic steps beside MuJoCo's in many worlds of an arm: ``python -m bench.arm_worlds [--device cuda:0]``.

The arm has two links and a slide with a disc magnet over four steel balls, or over an iron plate of 60 × 60 × 3 mm.
``gaps`` times ``Magnetics.apply`` and a step of MuJoCo with the magnet at rest at each gap, and compares the force with
that of finer moments. ``spacings`` does so at several spacings of the plate's moments. In ``phases`` the arm approaches
the plate, holds it and carries it away. Each measurement is one JSON line; ``--draw`` draws such lines.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import newton
import numpy as np
import warp as wp

import warpmag
from bench.machine import line_writer
from bench.timing import measure

LINK, HEIGHT = 0.12, 0.2  # length of a link, height of the arm [m]
DISC = {"radius": 0.01, "half_height": 0.0025}  # N42 magnet [m]
PLATE = {"hx": 0.03, "hy": 0.03, "hz": 0.0015}  # [m]
BALL, RING = 0.005, 0.02  # radius of a ball, and of the circle of all four [m]
TOPS = {"plate": 2.0 * PLATE["hz"], "balls": 2.0 * BALL}  # heights above the ground [m]
CASES = ("plate", "dipole"), ("balls", "dipole"), ("balls", "multipole")
"""Objects under the magnet, and contact models."""
GAPS = (0.1, 0.06, 0.04, 0.03, 0.02, 0.01, 0.005, 0.002, 0.0005, 0.0)  # between magnet and object [m]
SPACINGS = (0.012, 0.006, 0.0, 0.002)  # of the plate's moments [m]; 0 is automatic
SPACING_GAPS = (0.1, 0.02, 0.002)
REFINED = {"plate": 0.0015, "balls": 0.001}  # spacing of the moments of the reference [m]
DT = 5e-4  # [s]
HARD = {"ke": 1e6, "kd": 2e3, "mu": 0.5}
PHASES = {"approach": (0.02, 0.0), "hold": (0.0, 0.0), "carry": (0.0, 0.02)}
"""Heights of the slide above contact at the begin and the end of each phase [m]."""


def add_arm(builder: newton.ModelBuilder, top: float) -> int:
    """Add the arm, whose slide touches an object of height ``top`` [m] at position 0; return the body of the slide."""
    light = newton.ModelBuilder.ShapeConfig(density=500.0, has_shape_collision=False)
    upright, parent, joints = (0.0, 0.0, 1.0), -1, []
    for _ in range(2):
        link = builder.add_link()
        center = wp.transform((0.5 * LINK, 0.0, 0.0), wp.quat_identity())
        builder.add_shape_box(link, xform=center, hx=0.5 * LINK, hy=0.01, hz=0.005, cfg=light)
        end = wp.transform((0.0, 0.0, HEIGHT) if parent < 0 else (LINK, 0.0, 0.0), wp.quat_identity())
        drive = {"target_ke": 20.0, "target_kd": 0.5}
        joints.append(builder.add_joint_revolute(parent, link, parent_xform=end, axis=upright, **drive))
        parent = link
    slide, above = builder.add_link(), wp.transform((0.0, 0.0, 0.03), wp.quat_identity())
    heavy = newton.ModelBuilder.ShapeConfig(density=5000.0, has_shape_collision=False)
    builder.add_shape_box(slide, xform=above, hx=0.02, hy=0.02, hz=0.02, cfg=heavy)
    builder.add_shape_cylinder(slide, cfg=newton.ModelBuilder.ShapeConfig(density=7500.0, **HARD), **DISC)
    warpmag.add_permanent(builder, body=slide, material="N42", direction=upright)
    end = wp.transform((LINK, 0.0, top + DISC["half_height"] - HEIGHT), wp.quat_identity())
    drive = {"target_ke": 2e4, "target_kd": 200.0}
    joints.append(builder.add_joint_prismatic(parent, slide, parent_xform=end, axis=upright, **drive))
    builder.add_articulation(joints)
    return slide


def add_object(builder: newton.ModelBuilder, name: str, spacing: float) -> list[int]:
    """Add the balls or the plate under the magnet, with a spacing of moments [m]; return their bodies."""
    iron = newton.ModelBuilder.ShapeConfig(density=7870.0, **HARD)
    bodies = []
    for x, y in [(RING, 0.0), (0.0, RING), (-RING, 0.0), (0.0, -RING)] if name == "balls" else [(0.0, 0.0)]:
        place = wp.transform((2.0 * LINK + x, y, 0.5 * TOPS[name]), wp.quat_identity())
        bodies.append(builder.add_body(xform=place))
        if name == "balls":
            builder.add_shape_sphere(bodies[-1], radius=BALL, cfg=iron)
        else:
            builder.add_shape_box(bodies[-1], cfg=iron, **PLATE)
        warpmag.add_inducible(builder, body=bodies[-1], material="1010-steel", moment_spacing=spacing)
    return bodies


class ArmWorlds:
    """Worlds of the arm with its magnets and MuJoCo."""

    def __init__(
        self,
        name: str,
        worlds: int,
        device,
        *,
        spacing: float = 0.0,
        contact_model: str = "dipole",
        solver: bool = True,
    ):
        """Build the worlds. Without ``solver``, and in several worlds on a CPU, there is no MuJoCo."""
        world = newton.ModelBuilder()
        newton.solvers.SolverMuJoCo.register_custom_attributes(world)
        warpmag.register_custom_attributes(world)
        add_arm(world, TOPS[name])
        self._objects = add_object(world, name, spacing)
        builder, self.worlds, self.device = newton.ModelBuilder(), worlds, wp.get_device(device)
        newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
        warpmag.register_custom_attributes(builder)
        builder.replicate(world, worlds)
        builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(**HARD))
        self.model = builder.finalize(device=self.device)
        began = time.perf_counter()
        self.magnetics = warpmag.Magnetics(self.model, contact_model=contact_model)
        wp.synchronize_device(self.device)
        self.build_seconds = time.perf_counter() - began
        self.solver = None
        on_cpu = self.device.is_cpu
        if solver and not (on_cpu and worlds > 1):  # MuJoCo on a CPU simulates one world
            self.solver = newton.solvers.SolverMuJoCo(self.model, use_mujoco_cpu=on_cpu, nconmax=48, njmax=160)
        self.states, self.control = [self.model.state(), self.model.state()], self.model.control()

    def place(self, gaps) -> None:
        """Put the magnets at gaps [m], one for all worlds or shape [worlds]."""
        joints = self.model.joint_q.numpy().reshape(self.worlds, -1)
        joints[:, 2] = gaps
        joint_q = wp.array(joints.ravel(), dtype=float, device=self.device)
        newton.eval_fk(self.model, joint_q, self.model.joint_qd, self.states[0])
        wp.copy(self.states[0].joint_q, joint_q)
        self.aim(gaps)
        for _ in range(3):  # warm starts, and the change between few moments and cells
            self.apply()

    def aim(self, gaps) -> None:
        """Set the targets of the slides [m], one for all worlds or shape [worlds]."""
        targets = self.control.joint_target_q.numpy().reshape(self.worlds, -1)
        targets[:, 2] = gaps
        self.control.joint_target_q.assign(targets.ravel())

    def apply(self) -> None:
        """Launch one magnetic step."""
        self.states[0].clear_forces()
        self.magnetics.apply(self.states[0])

    def step_bodies(self) -> None:
        """Launch one step of MuJoCo, from the first state to the second."""
        self.solver.step(self.states[0], self.states[1], self.control, None, DT)

    def forces(self) -> np.ndarray:
        """Return the upward force on the objects of each world [N], shape [worlds]."""
        forces = self.states[0].body_f.numpy().astype(float).reshape(self.worlds, -1, 6)
        return forces[:, self._objects, 2].sum(axis=1)

    def heights(self) -> np.ndarray:
        """Return the height of the first object of each world [m], shape [worlds]."""
        return self.states[0].body_q.numpy().reshape(self.worlds, -1, 7)[:, self._objects[0], 2]

    def times(self) -> dict:
        """Return the times of a magnetic step and of MuJoCo's at the present poses [ms]."""
        options = {"repeats": 2, "chained": 3, "seconds": 0.3}
        result = {"magnetics_ms": 1e3 * measure(self.apply, self.device, **options)}
        if self.solver is not None:
            result["mujoco_ms"] = 1e3 * measure(self.step_bodies, self.device, **options)
        return result | {"evaluations": int(self.magnetics.evaluations.numpy().max())}


def forces_at(name: str, gaps, device, spacing: float) -> np.ndarray:
    """Return the upward force on the object [N] at gaps, each in a world of its own, shape [gaps]."""
    arm = ArmWorlds(name, len(gaps), device, spacing=spacing, solver=False)
    arm.place(gaps)
    return arm.forces()


def run_gaps(worlds: int, device, refined: dict) -> Iterator[dict]:
    """Yield times and forces at each gap in each case; ``refined`` has the spacings of the reference."""
    exact_forces = {name: forces_at(name, GAPS, device, refined[name]) for name in TOPS}
    for name, contact_model in CASES:
        exact, arm = exact_forces[name], ArmWorlds(name, worlds, device, contact_model=contact_model)
        for gap, reference in zip(GAPS, exact, strict=True):
            arm.place(gap)
            force = float(arm.forces()[-1])
            line = {"part": "gaps", "object": name, "contact_model": contact_model, "gap": gap, "worlds": worlds}
            line["build_seconds"] = arm.build_seconds
            yield line | arm.times() | {"force": force, "error": abs(force - reference) / abs(reference)}


def run_spacings(worlds: int, device, refined: dict) -> Iterator[dict]:
    """Yield times and errors of the plate at each spacing of its moments."""
    exact = forces_at("plate", SPACING_GAPS, device, refined["plate"])
    for spacing in SPACINGS:
        arm = ArmWorlds("plate", worlds, device, spacing=spacing, solver=False)
        cells = len(arm.magnetics.magnets[0].lattice.volumes)
        for gap, reference in zip(SPACING_GAPS, exact, strict=True):
            arm.place(gap)
            force = float(arm.forces()[-1])
            line = {"part": "spacings", "spacing": spacing, "cells": cells, "gap": gap, "worlds": worlds}
            yield line | arm.times() | {"force": force, "error": abs(force - reference) / abs(reference)}


def run_phases(worlds: int, device, steps: int) -> Iterator[dict]:
    """Yield means over each phase of ``steps`` steps, and the height of the plate after it.

    On a CPU there is one world.
    """
    worlds = 1 if wp.get_device(device).is_cpu else worlds
    arm = ArmWorlds("plate", worlds, device)
    arm.place(PHASES["approach"][0])
    graph = None
    for phase, (first, last) in PHASES.items():
        seconds, evaluations = 0.0, np.zeros(worlds, int)
        for target in np.linspace(first, last, steps):
            arm.aim(target)
            wp.synchronize_device(arm.device)
            began = time.perf_counter()
            graph = _step(arm, graph)
            wp.synchronize_device(arm.device)
            seconds += time.perf_counter() - began
            evaluations += arm.magnetics.evaluations.numpy()
        line = {"part": "phases", "phase": phase, "worlds": worlds, "step_ms": 1e3 * seconds / steps}
        line["mean_evaluations"] = float(evaluations.mean()) / steps
        heights = arm.heights()
        yield line | arm.times() | {"least_height": float(heights.min()), "greatest_height": float(heights.max())}


def _step(arm: ArmWorlds, graph):
    """Make one step of magnets and MuJoCo, on a GPU by a graph; return the graph."""

    def step():
        arm.apply()
        arm.step_bodies()
        for name in ("body_q", "body_qd", "joint_q", "joint_qd"):
            wp.copy(getattr(arm.states[0], name), getattr(arm.states[1], name))

    if arm.device.is_cpu:
        step()
        return None
    if graph is None:
        with wp.ScopedCapture(arm.device) as capture:
            step()
        graph = capture.graph
    wp.capture_launch(graph)
    return graph


PARTS = {"gaps": run_gaps, "spacings": run_spacings, "phases": run_phases}


def main(arguments=None) -> None:
    """Measure, or draw measured lines."""
    parser = argparse.ArgumentParser(prog="python -m bench.arm_worlds", description=__doc__.partition(":")[0])
    add = parser.add_argument
    add("--device", default="cpu")
    add("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="default: all")
    add("--worlds", type=int, help="number of worlds; 4,096 on a GPU, 1 on a CPU")
    add("--steps", type=int, default=150, help="steps of a phase (150)")
    add("--refined", type=float, help="spacing of the moments of the reference [m]")
    add("--draw", type=Path, nargs="+", help="draw these files instead of measuring")
    add("-o", "--output", type=Path, help="file that lines are appended to, or the picture")
    options = parser.parse_args(arguments)
    if options.draw:
        from bench.report import read  # noqa: PLC0415 - imports Matplotlib

        draw(read(options.draw), options.output or Path("bench_out/arm_worlds.png"))
        return
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(options.device)
    worlds = options.worlds or (1 if device.is_cpu else 4096)
    refined = dict.fromkeys(REFINED, options.refined) if options.refined else REFINED
    write = line_writer(device, options.output)
    for part in options.parts:
        for line in PARTS[part](worlds, device, options.steps if part == "phases" else refined):
            write({"case": "arm"} | line)


def draw(lines: list[dict], path: Path) -> None:
    """Draw cost against gap, error against gap, and error against cost."""
    import matplotlib.pyplot as plt  # noqa: PLC0415 - only drawing needs it

    from bench.report import machine_of  # noqa: PLC0415

    figure, (cost, error, both) = plt.subplots(3, 1, figsize=(6.3, 10.5), layout="constrained")
    of_part = {part: [line for line in lines if line["part"] == part] for part in PARTS}
    for case in CASES:
        points = [line for line in of_part["gaps"] if (line["object"], line["contact_model"]) == case and line["gap"]]
        gaps = [1e3 * line["gap"] for line in points]
        label = ", ".join(case) if case[0] == "balls" else case[0]  # the contact model acts on balls
        (curve,) = cost.plot(gaps, [line["magnetics_ms"] for line in points], marker=".", label=label)
        style = {"color": curve.get_color(), "marker": "."}
        if case[1] == "dipole":
            times = [line.get("mujoco_ms") for line in points]
            cost.plot(gaps, times, linestyle="--", label=f"MuJoCo with {case[0]}", **style)
        error.plot(gaps, [100.0 * line["error"] for line in points], label=label, **style)
    for gap in SPACING_GAPS:
        points = [line for line in of_part["spacings"] if line["gap"] == gap]
        times = [1e3 * line["magnetics_ms"] / line["worlds"] for line in points]
        both.plot(times, [100.0 * line["error"] for line in points], marker="o", label=f"gap {1e3 * gap:g} mm")
        for x, line in zip(times, points, strict=True):
            both.annotate(f"{line['cells']}", (x, 100.0 * line["error"]), fontsize="x-small")
    worlds = of_part["gaps"][0]["worlds"] if of_part["gaps"] else 0
    cost.set(ylabel=f"time of a step of {worlds:,} world{'s' * (worlds > 1)} [ms]", xlabel="gap [mm]")
    error.set(ylabel="error of the force [%]", xlabel="gap [mm]")
    both.set(xlabel="magnetic step of a world [µs]", ylabel="error of the force [%]")
    both.set_title("plate, numbers of cells", fontsize="small")
    for axis in (cost, error, both):
        axis.set(xscale="log", yscale="log")
        for numbers in (axis.xaxis, axis.yaxis):  # at 1, 2 and 5 of each decade
            numbers.set_major_formatter("{x:g}")
            numbers.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:e}"[0] in "25" else "")
        axis.grid(True, alpha=0.3)
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize="x-small")
    figure.suptitle(f"{machine_of(lines[0])}, commit {lines[0]['commit']}", fontsize="small")
    figure.savefig(path, dpi=120, pil_kwargs={"optimize": True})
    plt.close(figure)


if __name__ == "__main__":
    main()
