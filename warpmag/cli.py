"""The ``warpmag`` command."""

import argparse
import contextlib
import os
import signal
import sys
import traceback
from pathlib import Path

from warpmag import __version__
from warpmag.declarations.magnets import CONTACT_MODELS, DYNAMICS, FORCES, METHODS, PRESETS, check_rtol, check_token
from warpmag.engine.pile_xpbd.solvers import SOLVERS
from warpmag.errors import InputError, SimulationError, one_line
from warpmag.moments.ranks import Ranks, current_ranks, is_first_rank, on_first_rank, without_ranks
from warpmag.progress import Progress
from warpmag.terminal import (
    Stopped,
    collection_paused,
    log,
    open_standard_files,
    quiet_warp,
    signals_guarded,
    signals_raised,
    silence,
)

BAD_INPUT, FAILED, STOPPED = 2, 1, 128
"""Exit codes. 0 is success. A command ended by a signal exits with ``STOPPED`` plus the signal's number."""

_VIEWERS = {"gl": "ViewerGL", "viser": "ViewerViser", "rerun": "ViewerRerun"}
_BROWSER_VIEWERS = ("viser", "rerun")
"""Viewers in a browser, which show the scene only while the command runs."""
_OUTPUT_FOLDER = Path("warpmag_out")
_DEVICE_HELP = "Warp device, cpu or cuda:0 (default: the first GPU, else cpu)"


class _Parser(argparse.ArgumentParser):
    """A parser that raises :class:`InputError`."""

    def error(self, message: str):
        raise InputError(f"{message} (see {self.prog} --help)")


class _Method(argparse.Action):
    """Store the summation method. ``--sums``, and presets as values of ``--method``, are deprecated spellings."""

    def __call__(self, parser, namespace, values, option_string=None):
        """Store the value as the method, or as the preset if ``--method`` names a preset."""
        option = self.option_strings[0]
        name = "preset" if values in PRESETS and option == "--method" else "method"
        if name == "method":
            check_token(option.strip("-"), values, METHODS)
        if f"--{name}" != option:
            _warn([f"{option} {values} is deprecated, write --{name} {values}"])
        setattr(namespace, name, values)


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    open_standard_files()
    try:
        all_ranks = current_ranks()
    except InputError as error:
        log(error)
        return BAD_INPUT
    code, line = _execute(arguments, all_ranks)
    if line and all_ranks is not None:
        all_ranks.fail(line, code, log)
    elif line:
        log(line)
    return code


def _execute(arguments: list[str] | None, all_ranks: Ranks | None) -> tuple[int, str]:
    """Run the command and return its exit code and an error line, which is empty on success."""
    try:
        with signals_raised():
            options = _parser().parse_args(arguments)
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
        return FAILED, one_line(f"not enough memory ({error})" if str(error) else "not enough memory")
    except BrokenPipeError:
        silence(1)
        return STOPPED + signal.SIGPIPE, "the standard output was closed"
    except OSError as error:  # a full disk or a lost folder; Python repeats an error of a standard file at exit
        silence(1)
        return FAILED, one_line(str(error))
    except Exception as error:
        if all_ranks is None:
            raise
        traceback.print_exc()  # return, so that the other ranks end as well
        return FAILED, f"{type(error).__name__}: {error}"


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="warpmag", description="Magnets for the Newton physics engine.")
    parser.add_argument("--version", action="version", version=f"warpmag {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_run(commands)
    scenes = commands.add_parser("scenes", help="list the bundled scenes")
    scenes.set_defaults(command=_scenes)

    check = commands.add_parser("check", help="report the contents and the errors of a stage")
    check.add_argument("stage", metavar="STAGE", help="a USD file, or a bundled scene")
    check.set_defaults(command=_check)

    _add_render(commands)
    _add_export(commands)
    return parser


def _add_run(commands) -> None:
    run = commands.add_parser("run", help="simulate a scene and write it as a USD stage")
    run.set_defaults(command=_run)
    add = run.add_argument
    add("scene", metavar="SCENE", help="a bundled scene (see 'warpmag scenes') or a USD file")
    add("-o", "--output", metavar="OUT", help="USD file to write (default: warpmag_out/SCENE.usda)")
    add("--balls", type=int, metavar="N", help="number of balls of falling_magnet, sakura_tree or million")
    add("--frames", type=int, metavar="N", help="output frames to simulate (default: the time range of the stage)")
    add("--resume", action="store_true", help="continue the run at the output, if there is one")
    add("--device", help=_DEVICE_HELP)
    add("--solver", choices=SOLVERS, default=next(iter(SOLVERS)), help="rigid-body solver (default: %(default)s)")
    text = "force law, dynamics, and curve of all magnets: from this library, Kim and Han 2022, or Kim et al. 2018"
    add("--preset", choices=PRESETS, help=text)
    add("--force", choices=FORCES, help="force law (default: the stage's)")
    add("--dynamics", choices=DYNAMICS, help="magnetization dynamics (default: the stage's)")
    add("--contact-model", choices=CONTACT_MODELS, help="model of balls that nearly touch (default: the stage's)")
    names = f"{{{','.join(METHODS)}}}"
    text = "summation by the faster method, over all pairs, or by multipoles (default: %(default)s)"
    add("--method", action=_Method, default=METHODS[0], metavar=names, help=text)
    add("--sums", dest="method", action=_Method, default=METHODS[0], help=argparse.SUPPRESS)
    text = "relative magnetization error at which induction ends, at least 2e-6 (default: the stage's)"
    add("--rtol", type=float, metavar="X", help=text)
    text = "viewer that shows the run (default: %(default)s)"
    add("--viewer", choices=("none", *_VIEWERS), default="none", help=text)
    text = "also write a stage for renderers beside the output, as 'warpmag export' does"
    add("--for", dest="purpose", choices=("render",), help=text)


def _add_render(commands) -> None:
    render = commands.add_parser("render", help="draw frames of a stage or of a finished run")
    render.set_defaults(command=_render)
    add = render.add_argument
    add("stage", metavar="STAGE", help="a USD file, or a bundled scene")
    add("-o", "--output", metavar="FILE", required=True, help="picture (.png) or film (.mp4, .gif)")
    frames = render.add_mutually_exclusive_group()
    text = "number of the frame to draw, 0 for the start (default: the last)"
    frames.add_argument("--frame", type=int, metavar="N", help=text)
    frames.add_argument("--frames", metavar="A:B", help="first and last frame to draw (default for a film: all)")
    add("--size", metavar="WxH", default="960x540", help="width and height [px] (default: %(default)s)")
    text = "draft, or final by Blender's path tracer (default: %(default)s)"
    add("--quality", choices=("draft", "final"), default="draft", help=text)
    add("--moments", action="store_true", help="draw the moments of a finished run as arrows")
    add("--device", help=_DEVICE_HELP)


def _add_export(commands) -> None:
    text = "export a scene or a finished run: a stage for renderers, a web page, or numbers"
    export = commands.add_parser("export", help=text)
    export.set_defaults(command=_export)
    add = export.add_argument
    add("stage", metavar="STAGE", help="a USD file, or a bundled scene")
    text = "file: .usda, .usdc or .usdz for renderers, .html for a web page, .npz or .csv for numbers"
    add("-o", "--output", metavar="OUT", required=True, help=text)
    text = "frames per second (default: %(default)g, as in Blender)"
    add("--rate", type=float, default=24.0, metavar="HZ", help=text)
    add("--color", metavar="QUANTITY", help="color bodies by magnetization, speed or force")
    add("--arrows", action="store_true", help="draw moments as arrows")
    add("--field-lines", type=int, default=0, metavar="N", help="draw N field lines of the permanent magnets")
    add("--materialx", action="store_true", help="also write materials as MaterialX")
    add("--device", help=_DEVICE_HELP)


def _scenes(options) -> int:
    from warpmag.scenes_usd import MADE, bundled, summary  # noqa: PLC0415 - each command imports what it needs
    from warpmag.usd import describe  # noqa: PLC0415

    lines = {name: describe(path) for name, path in bundled().items()} | {name: summary(name) for name in MADE}
    width = max(map(len, lines))
    for name, line in sorted(lines.items()):
        print(f"{name:{width}}  {line}")
    return 0


def _find_scene(name: str, balls: int | None = None, folder: Path = _OUTPUT_FOLDER) -> tuple[Path, bool]:
    """Return the file of a scene, and whether it is bundled. A generated scene is written to ``folder``."""
    from warpmag.scenes_usd import MADE, bundled, make  # noqa: PLC0415
    from warpmag.usd import usable_path  # noqa: PLC0415

    scenes = bundled()
    path = usable_path(name)
    if name in (*scenes, *MADE) and not os.path.isfile(path):
        if balls is None and name in scenes:
            return scenes[name], True
        generated = on_first_rank(lambda: make(name, folder, balls), current_ranks())
        if is_first_rank(current_ranks()):
            log(f"scene: {generated}")
        return generated, False
    if not os.path.exists(path) and not path.suffix:
        raise InputError(f"{name}: no such file and no bundled scene (bundled: {', '.join((*scenes, *MADE))})")
    if balls is not None:
        raise InputError(f"balls: {name} is a file; --balls is for bundled scenes")
    return path, False


@signals_guarded()
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
    currents = sum(source.currents is not None for source in sources)
    if contents.motions or contents.magnetization_keys or contents.field_keys or currents:
        more = f", {currents} currents" if currents else ""
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
            warnings = _load(Path(report.path)).warnings()
        except InputError as error:
            errors.append(str(error))
    for severity, lines in (("error", errors), ("warning", warnings)):
        for line in lines:
            print(f"{severity:11} {line}")
    return BAD_INPUT if errors else 0


@collection_paused()
def _load(path: Path, **options):
    """Return the simulation of a stage."""
    _start_warp(path)
    from warpmag.engine.stepping.simulation import Simulation  # noqa: PLC0415

    return Simulation(path, **options)


def _start_warp(path: Path) -> None:
    """Initialize Warp; on a terminal, print that the stage is loading. Call this before the engine is imported."""
    quiet_warp()
    if sys.stderr.isatty():
        print(f"{path.stem}: loading (the first run compiles kernels for a minute or two)", file=sys.stderr)


def _render(options) -> int:
    path, _ = _find_scene(options.stage)
    _start_warp(path)
    if options.quality == "final":
        from warpmag.show.blender import render_final  # noqa: PLC0415

        if options.frames or options.moments:
            raise InputError("quality: 'final' draws one frame without moments; 'warpmag export --arrows' draws them")
        size = _pair("size", options.size, "x")
        print(f"written {render_final(path, options.output, frame=options.frame, size=size)}")
        return 0
    from warpmag.show.ray_tracing import render  # noqa: PLC0415

    frames = _pair("frames", options.frames, ":") if options.frames is not None else None
    settings = {"size": _pair("size", options.size, "x"), "moments": options.moments, "device": options.device}
    written = render(path, options.output, frame=options.frame, frames=frames, **settings)
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

    names = ("rate", "color", "arrows", "field_lines", "materialx", "device")
    for line in export(path, options.output, **{name: getattr(options, name) for name in names}):
        print(line)
    print(f"written {options.output}")
    return 0


def _run(options) -> int:
    if options.frames is not None and options.frames < 1:
        raise InputError(f"frames: must be positive, got {options.frames}")
    if options.rtol is not None:
        check_rtol("rtol", options.rtol)
    if options.viewer != "none" and current_ranks() is not None:
        raise InputError("viewer: a run with several ranks cannot have one")
    folder = Path(options.output).parent if options.output else _OUTPUT_FOLDER
    path, is_bundled = _find_scene(options.scene, options.balls, folder)
    display, resume = None, options.resume
    while True:
        simulation = _simulation_of(path, options)
        if display:
            display.restart(simulation.model, simulation.magnetics)
        else:
            display = _open_display(options.viewer, simulation)
        _simulate(simulation, path, options, display, copy_scene=is_bundled, resume=resume)
        if not (display and display.restarted):
            return 0
        resume = False  # a restart in the viewer begins at the first frame


def _simulation_of(path: Path, options):
    """Return the simulation that the options describe."""
    preset = PRESETS[options.preset] if options.preset else None
    settings = {name: getattr(options, name) for name in ("solver", "contact_model", "method", "rtol", "device")}
    settings["force"] = options.force or (preset and preset.force)
    settings["dynamics"] = options.dynamics or (preset and preset.dynamics)
    return _load(path, **settings, curve=preset and preset.curve, visuals=options.viewer != "none")


def _simulate(simulation, path: Path, options, display, *, copy_scene: bool, resume: bool) -> None:
    """Run to the end, or until the viewer restarts or closes, and print the summary."""
    output = Path(options.output) if options.output else _OUTPUT_FOLDER / f"{path.stem}.usda"
    warnings = simulation.warnings()
    _warn(warnings)
    progress = Progress(simulation.frames_of(options.frames))

    def show(frame: int) -> bool:
        if is_first_rank(current_ranks()):
            progress.show(frame)
        return display is None or display.follow(simulation.time, simulation.state)

    try:
        statistics = simulation.run(progress.frames, output=output, copy_scene=copy_scene, resume=resume, on_frame=show)
    finally:
        progress.close()
    if (display and display.restarted) or not is_first_rank(current_ranks()):
        return
    if progress.done is None:
        print(f"complete       {output} already has all {progress.frames} frames")
        return
    for line in statistics.summary():
        print(line)
    print(f"written        {output}")
    if options.purpose:
        from warpmag.show.export import export  # noqa: PLC0415

        with without_ranks():
            export(output, rendered := output.with_name(f"{output.stem}.render.usdc"), device=options.device)
        print(f"to render      {rendered}")
    _warn([line for line in simulation.warnings() if line not in warnings])
    if simulation.capture_failure:
        _warn([f"steps were launched kernel by kernel, which is slower: {simulation.capture_failure}"])
    if display is not None and options.viewer in _BROWSER_VIEWERS and display.viewer.is_running():
        log(f"the {options.viewer} viewer shows the last frame until Ctrl-C")
        display.stay()


def _warn(lines: list[str]) -> None:
    for line in lines if is_first_rank(current_ranks()) else ():
        log(f"warning: {line}")


def _open_display(name: str, simulation):
    if name == "none":
        return None
    import newton  # noqa: PLC0415

    from warpmag.show.viewers import Display, no_viewer  # noqa: PLC0415

    try:
        viewer = getattr(newton.viewer, _VIEWERS[name])()
    except Exception as error:  # viewers raise errors of many types
        raise no_viewer(name, error) from None
    display = Display(viewer, simulation.model, simulation.magnetics)
    display.allow_restart()
    return display


if __name__ == "__main__":
    sys.exit(main())
