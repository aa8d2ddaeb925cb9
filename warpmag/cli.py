"""The ``warpmag`` command."""

import argparse
import contextlib
import os
import signal
import sys
import traceback
from pathlib import Path

from warpmag.terminal import interrupted_silently

with interrupted_silently():
    from warpmag.command_options import VIEWERS, make_parser
    from warpmag.declarations.checks import check_positive
    from warpmag.declarations.magnets import PRESETS, check_rtol
    from warpmag.declarations.materials import MATERIALS
    from warpmag.errors import InputError, SimulationError, one_line
    from warpmag.kernel_loading import watch_kernels
    from warpmag.moments.ranks import Ranks, current_ranks, is_first_rank, on_first_rank, without_ranks
    from warpmag.progress import Progress, Waiting
    from warpmag.stopwatch import Stopwatch, process_age
    from warpmag.terminal import (
        STOPPED,
        Stopped,
        collection_paused,
        log,
        open_standard_files,
        quiet_warp,
        signals_raised,
        silence,
        skip_last_collection,
    )

BAD_INPUT, FAILED = 2, 1
"""Exit codes. 0 is success. A command ended by a signal exits with ``STOPPED`` plus the signal's number."""

_BROWSER_VIEWERS = ("viser", "rerun")
"""Viewers in a browser, which show the scene only while the command runs."""
_OUTPUT_FOLDER = Path("warpmag_out")


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code. Without ``arguments``, its time counts from the process's start."""
    stopwatch = Stopwatch(process_age() if arguments is None else 0.0)
    open_standard_files()
    try:
        all_ranks = current_ranks()
    except InputError as error:
        log(error)
        return BAD_INPUT
    code, line = _execute(arguments, all_ranks, stopwatch)
    Waiting.end()
    if line and all_ranks is not None:
        all_ranks.fail(line, code, log)
    elif line:
        log(line)
    if arguments is None:
        skip_last_collection()
    return code


def _execute(arguments: list[str] | None, all_ranks: Ranks | None, stopwatch: Stopwatch) -> tuple[int, str]:
    """Run the command and return its exit code and an error line, which is empty on success."""
    try:
        with signals_raised():
            options = _parser().parse_args(arguments)
            options.stopwatch = stopwatch
            if not is_first_rank(all_ranks):
                if options.command is not _run:
                    return 0, ""  # ranks share the command 'run' only
                silence(1)
            with contextlib.nullcontext() if options.command is _run else without_ranks():
                code = options.command(options)
            sys.stdout.flush()
            return code, ""
    except InputError as error:
        return BAD_INPUT, str(error)
    except SimulationError as error:
        return FAILED, str(error)
    except Stopped as stopped:
        return STOPPED + stopped.number, str(stopped)
    except MemoryError as error:
        return FAILED, _no_memory(str(error))
    except BrokenPipeError:
        silence(1)
        return STOPPED + signal.SIGPIPE, "the standard output was closed"
    except OSError as error:  # a full disk or a lost folder; Python repeats an error of a standard file at exit
        silence(1)
        return FAILED, one_line(str(error))
    except Exception as error:
        if str(error).startswith("Failed to allocate"):  # Warp's RuntimeError
            return FAILED, _no_memory(str(error))
        if all_ranks is None:
            raise
        traceback.print_exc()  # return, so that the other ranks end as well
        return FAILED, f"{type(error).__name__}: {error}"


def _no_memory(reason: str) -> str:
    return one_line(f"not enough memory ({reason})" if reason else "not enough memory")


def _parser() -> argparse.ArgumentParser:
    commands = {"run": _run, "scenes": _scenes, "materials": _materials}
    return make_parser({**commands, "check": _check, "render": _render, "export": _export})


def _scenes(options) -> int:
    from warpmag.scenes_usd import GENERATED_SCENES, bundled, summary  # noqa: PLC0415 - each command imports what it needs
    from warpmag.usd import describe  # noqa: PLC0415

    lines = {name: describe(path) for name, path in bundled().items()} | {
        name: summary(name) for name in GENERATED_SCENES
    }
    width = max(map(len, lines))
    for name, line in sorted(lines.items()):
        print(f"{name:{width}}  {line}")
    return 0


def _materials(_) -> int:
    rows = [("name", "kind", "strength", "relative permeability", "density")]
    for material in MATERIALS.values():
        soft = material.kind == "inducible"
        strength = f"{'saturation' if soft else 'remanence'} {material.polarization:g} T"
        permeability = f"{material.permeability:g}" if soft else "-"
        kind = f"{material.kind}{', measured curve' if material.curve else ''}"
        rows.append((material.name, kind, strength, permeability, f"{material.density:g} kg/m³"))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(f"{text:{width}}" for text, width in zip(row, widths, strict=True)).rstrip())
    return 0


def _find_scene(name: str, balls: int | None = None, folder: Path = _OUTPUT_FOLDER) -> tuple[Path, bool]:
    """Return the file of a scene, and whether it is bundled. A generated scene is written to ``folder``."""
    from warpmag.scenes_usd import GENERATED_SCENES, bundled, make  # noqa: PLC0415
    from warpmag.usd import usable_path  # noqa: PLC0415

    scenes = bundled()
    path = usable_path(name)
    if name in (*scenes, *GENERATED_SCENES) and not os.path.isfile(path):
        if balls is None and name in scenes:
            return scenes[name], True
        generated = on_first_rank(lambda: make(name, folder, balls), current_ranks())
        if is_first_rank(current_ranks()):
            log(f"scene: {generated}")
        return generated, False
    if not os.path.exists(path) and not path.suffix:
        raise InputError(
            f"{name}: no such file and no bundled scene (bundled: {', '.join((*scenes, *GENERATED_SCENES))})"
        )
    if balls is not None:
        raise InputError(f"balls: {name} is a file; --balls is for bundled scenes")
    return path, False


def _check(options) -> int:
    from warpmag.usd import check  # noqa: PLC0415

    report = check(_find_scene(options.stage)[0])
    contents = report.contents
    print(f"stage       {report.path}")
    print(f"units       {report.meters_per_unit:g} m, {report.kilograms_per_unit:g} kg, {report.up_axis} up")
    if report.clock:
        clock = report.clock
        step = "not given" if clock.step is None else f"{1e3 * clock.step:g} ms"
        seconds = (clock.end - clock.start) / clock.time_codes_per_second
        print(f"time        {seconds:g} s at {clock.frames_per_second:g} frames per second, physics step {step}")
    bodies, kinematic, colliders = map(len, (contents.bodies, contents.kinematic, contents.colliders))
    print(f"bodies      {bodies} ({kinematic} kinematic), {colliders} colliders")
    print(f"magnets     {len(report.magnets('inducible'))} inducible, {len(report.magnets('permanent'))} permanent")
    sources = [source for group in contents.sources.values() for source in group]
    coils = sum(source.drive is not None for source in sources)
    if contents.motions or contents.magnetization_keys or contents.field_keys or coils:
        more = f", {_counted(coils, 'coil')}" if coils else ""
        more += ", the external field" if contents.field_keys else ""
        print(f"keyed       {len(contents.motions)} bodies, {len(contents.magnetization_keys)} magnetizations{more}")
    if sources:
        types = [type(source.source).__name__ for source in sources]
        print(f"sources     {types.count('Coil')} coils, {types.count('FieldMap')} field maps")
    settings = contents.settings
    field = ", ".join(f"{value:g}" for value in settings.external_field)
    laws = f"{settings.force}, {settings.dynamics}, {settings.contact_model}"
    print(f"magnetics   {laws}, rtol {settings.rtol:g}, external field ({field}) A/m")
    errors, warnings = list(map(str, report.errors)), list(map(str, report.warnings))
    if not errors:
        try:
            simulation = _load(Path(report.path))
            warnings = simulation.warnings()
            print(f"moments     {simulation.moments_line()}")
        except InputError as error:
            errors.append(str(error))
    for severity, lines in (("error", errors), ("warning", warnings)):
        for line in lines:
            print(f"{severity:11} {line}")
    print(f"verdict     {_verdict(len(errors), len(warnings))}")
    return BAD_INPUT if errors else 0


def _verdict(errors: int, warnings: int) -> str:
    """Return the result of a check in words."""
    noted = f", with {_counted(warnings, 'warning')}" if warnings else ""
    return f"cannot be run: {_counted(errors, 'error')}" if errors else f"ready to run{noted}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' * (number != 1)}"


@collection_paused()
def _load(path: Path, **options):
    """Return the simulation of a stage."""
    _start_warp(path)
    from warpmag.engine.stepping.simulation import Simulation  # noqa: PLC0415

    simulation = Simulation(path, **options)
    Waiting.end()
    return simulation


def _start_warp(path: Path) -> None:
    """Initialize Warp; on a terminal, show that the stage is loading. Call this before the engine is imported.

    A compilation of kernels is announced before it begins, on a terminal or not.
    """
    if is_first_rank(current_ranks()):
        Waiting(f"{path.stem}: loading")
    quiet_warp()
    watch_kernels(lambda: _status(f"{path.stem}: compiling kernels on first use, for up to a minute or two"))


def _status(line: str) -> None:
    """Print a line on stderr, of the first rank, on a line of its own also where a bar is drawn."""
    if is_first_rank(current_ranks()):
        Progress.interrupt(line)


def _render(options) -> int:
    path, _ = _find_scene(options.stage)
    _start_warp(path)
    if options.quality == "final":
        from warpmag.show.blender import render_final  # noqa: PLC0415

        if options.frames or options.arrows:
            raise InputError("quality: 'final' draws one frame without arrows; 'warpmag export --arrows' draws them")
        if options.camera:
            raise InputError("camera: goes with the quality 'draft' only; 'final' draws the first camera")
        size = _pair("size", options.size, "x")
        print(f"written {render_final(path, options.output, frame=options.frame, size=size)}")
        return 0
    from warpmag.show.ray_tracing import render  # noqa: PLC0415

    frames = _pair("frames", options.frames, ":") if options.frames is not None else None
    settings = {name: getattr(options, name) for name in ("arrows", "camera", "device", "frame")}
    settings |= {"size": _pair("size", options.size, "x"), "frames": frames}
    Waiting.end()
    written = render(path, options.output, **settings, on_camera=lambda line: print(f"drawn   {line}"))
    print(f"written {written[0]}{f' to {written[-1].name}' if len(written) > 1 else ''}")
    return 0


def _pair(name: str, text: str, separator: str) -> tuple[int, int]:
    """Return the two whole numbers of an argument, such as 960x540."""
    parts = text.lower().split(separator)
    if len(parts) != 2 or not all(part.isdecimal() and len(part) < 10 for part in parts):
        raise InputError(f"{name}: must be two whole numbers such as 10{separator}20, got {text!r:.40}")
    return int(parts[0]), int(parts[1])


def _export(options) -> int:
    path, _ = _find_scene(options.stage)
    _start_warp(path)
    from warpmag.show.export import export  # noqa: PLC0415

    names = ("fps", "color", "arrows", "field_lines", "materialx", "device")
    Waiting.end()
    for line in export(path, options.output, **{name: getattr(options, name) for name in names}):
        print(line)
    print(f"written {options.output}")
    return 0


def _run(options) -> int:
    _check_run(options)
    folder = Path(options.output).parent if options.output else _OUTPUT_FOLDER
    path, is_bundled = _find_scene(options.scene, options.balls, folder)
    output = Path(options.output) if options.output else _OUTPUT_FOLDER / f"{path.stem}.usda"
    if not (options.overwrite or options.resume):
        on_first_rank(lambda: _check_new(output), current_ranks())
    display, resume = None, options.resume
    while True:
        simulation = _simulation_of(path, options)
        if display:
            display.restart(simulation.model, simulation.magnetics)
        else:
            options.display = display = _open_display(options.viewer, simulation)
        options.stopwatch.end_part("loading")
        _simulate(simulation, output, options, display, copy_scene=is_bundled, resume=resume)
        if not (display and display.restarted):
            return 0
        resume = False  # a restart in the viewer begins at the first frame


def _check_run(options) -> None:
    """Raise :class:`InputError` for options that no scene can have."""
    if options.frames is not None and options.frames < 1:
        raise InputError(f"frames: must be positive, got {options.frames}")
    for name in ("duration", "step"):
        if (seconds := getattr(options, name)) is not None:
            check_positive(name, seconds)
    if options.rtol is not None:
        check_rtol("rtol", options.rtol)
    if options.viewer != "none" and current_ranks() is not None:
        raise InputError("viewer: a run with several ranks cannot have one")


def _check_new(output: Path) -> None:
    """Raise :class:`InputError` if the output exists."""
    if os.path.exists(output):  # a name that is too long is an error of the writer; Path.exists() raises OSError
        raise InputError(
            f"{output}: exists; add --overwrite to replace it, --resume to continue its run, or another -o"
        )


def _simulation_of(path: Path, options):
    """Return the simulation that the options describe."""
    preset = PRESETS[options.preset] if options.preset else None
    names = ("solver", "contact_model", "method", "rtol", "external_field", "device")
    settings = {name: getattr(options, name) for name in names}
    settings["force"] = options.force or (preset and preset.force)
    settings["dynamics"] = options.dynamics or (preset and preset.dynamics)
    settings |= {"dt": options.step, "curve": preset and preset.curve, "visuals": options.viewer != "none"}
    if options.viewer != "none":  # the mouse drags bodies; Newton's viewers launch kernels only
        settings |= {"graphs": True, "on_substep": lambda state, _: options.display.apply_forces(state)}
    return _load(path, **settings)


def _frames_of(simulation, options) -> int:
    """Return the number of frames that the options ask for."""
    if options.duration is None:
        return simulation.frames_of(options.frames)
    return simulation.frames_of(max(1, round(options.duration * simulation.frame_rate)))


def _simulate(simulation, output: Path, options, display, *, copy_scene: bool, resume: bool) -> None:
    """Run to the end, or until the viewer restarts or closes, and print the summary."""
    warnings = simulation.warnings()
    _warn(warnings)
    progress = Progress(_frames_of(simulation, options))

    def show(frame: int) -> bool:
        if is_first_rank(current_ranks()):
            progress.show(frame)
        return display is None or display.follow(simulation.time, simulation.state)

    if is_first_rank(current_ranks()):
        Waiting("first frame")
    try:
        statistics = simulation.run(progress.frames, output=output, copy_scene=copy_scene, resume=resume, on_frame=show)
    finally:
        progress.close()
    options.stopwatch.end_part("run")
    if (display and display.restarted) or not is_first_rank(current_ranks()):
        return
    if progress.done is None:
        print(f"complete       {output} already has all {progress.frames} frames")
        return
    for line in statistics.summary(details=options.verbose):
        print(line)
    if options.verbose:
        print(f"moments        {simulation.moments_line()}")
    print(f"written        {output}")
    _export_beside(output, options)
    _warn([line for line in simulation.warnings() if line not in warnings])
    if simulation.capture_failure:
        _warn([f"steps were launched kernel by kernel, which is slower: {simulation.capture_failure}"])
    if display is not None and options.viewer in _BROWSER_VIEWERS and display.viewer.is_running():
        log(f"the {options.viewer} viewer shows the last frame until Ctrl-C")
        display.stay()
        options.stopwatch.end_part("viewing")
    options.stopwatch.end_part("rest")
    print(options.stopwatch.line())


def _export_beside(output: Path, options) -> None:
    """Write a stage for renderers beside the output if the options ask for it."""
    if options.purpose:
        from warpmag.show.export import export  # noqa: PLC0415

        with without_ranks():
            export(output, rendered := output.with_name(f"{output.stem}.render.usdc"), device=options.device)
        print(f"to render      {rendered}")
        options.stopwatch.end_part("export")


def _warn(lines: list[str]) -> None:
    for line in lines if is_first_rank(current_ranks()) else ():
        log(f"warning: {line}")


def _open_display(name: str, simulation):
    if name == "none":
        return None
    import newton  # noqa: PLC0415

    from warpmag.show.viewers import Display, no_viewer  # noqa: PLC0415

    try:
        viewer = getattr(newton.viewer, VIEWERS[name])()
    except Exception as error:  # viewers raise errors of many types
        raise no_viewer(name, error) from None
    display = Display(viewer, simulation.model, simulation.magnetics)
    display.allow_restart()
    return display


if __name__ == "__main__":
    sys.exit(main())
