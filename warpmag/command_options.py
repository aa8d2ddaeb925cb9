"""Options of the ``warpmag`` command, with their help and examples."""

import argparse
import re
import sys
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

from warpmag import __version__
from warpmag.declarations.magnets import CONTACT_MODELS, DYNAMICS, FORCES, METHODS, PRESETS, check_token
from warpmag.engine.pile_xpbd.solvers import SOLVERS
from warpmag.errors import InputError
from warpmag.moments.ranks import current_ranks, is_first_rank
from warpmag.terminal import log

VIEWERS = {"gl": "ViewerGL", "viser": "ViewerViser", "rerun": "ViewerRerun"}
"""Viewers of ``newton.viewer`` by the value of ``--viewer``."""
_DEVICE = "Warp device, cpu or cuda:0 (default: the first GPU, else cpu)"
_CONTACT_MODEL = (
    "model of balls that nearly touch (default: the stage's, else dipole, which underestimates the attraction of two "
    "balls in line with the field by up to 34 %% at a gap of 0.3 radii and 93 %% at 0.01)"
)
_STAGE = "a USD file, or a bundled scene (see 'warpmag scenes')"
_RUN_EXAMPLES = """
  warpmag run balls_up                      simulate a bundled scene, write warpmag_out/balls_up.usda
  warpmag run lift.usda -o out/lift.usda    simulate a stage, write another file
  warpmag run lift.usda --duration 0.5 --step 5e-4 --overwrite
  warpmag run lift.usda --external-field 0 0 8e4
  warpmag run balls_up --viewer gl          watch the run in a window
"""
_RENDER_EXAMPLES = """
  warpmag render warpmag_out/balls_up.usda -o last.png
  warpmag render warpmag_out/balls_up.usda -o film.mp4 --arrows
  warpmag render warpmag_out/balls_up.usda -o frame.png --frames 10:20 --size 1280x720
"""
_EXPORT_EXAMPLES = """
  warpmag export warpmag_out/balls_up.usda -o balls_up.html
  warpmag export warpmag_out/balls_up.usda -o balls_up.usdc --fps 30 --color force
  warpmag export warpmag_out/balls_up.usda -o balls_up.csv
"""
_EXAMPLES = """
  warpmag scenes                            list the bundled scenes
  warpmag check lift.usda                   report the contents and the errors of a stage
  warpmag run balls_up                      simulate, write warpmag_out/balls_up.usda
  warpmag render warpmag_out/balls_up.usda -o last.png
  warpmag export warpmag_out/balls_up.usda -o balls_up.html
"""


class _Parser(argparse.ArgumentParser):
    """A parser that raises :class:`InputError`, and reads numbers such as -8e4 as values.

    Help that cannot be written raises ``OSError``.
    """

    def __init__(self, *arguments, **named):
        """Keep the lines of the examples as they are."""
        super().__init__(*arguments, **named, formatter_class=argparse.RawDescriptionHelpFormatter)
        self._negative_number_matcher = re.compile(r"-\d*\.?\d+(e[-+]?\d+)?$", re.IGNORECASE)

    def _print_message(self, message: str, file: Any = None) -> None:
        print(message, end="", file=file or sys.stderr, flush=True)

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


class _Method(argparse.Action):
    """Store the summation method. Presets as values of ``--method`` are a deprecated spelling."""

    def __call__(self, parser, namespace, values, option_string=None):
        """Store the value as the method, or as the preset if it names one."""
        if values in PRESETS:
            _warn_of_spelling(f"--method {values}", f"--preset {values}")
            namespace.preset = values
        else:
            check_token("method", values, METHODS)
            namespace.method = values


class _Renamed(argparse.Action):
    """Store a value or, for ``const``, that constant under the present name of an option, with a warning."""

    def __call__(self, parser, namespace, values, option_string=None):
        """Warn, and store the value."""
        present = f"--{self.dest}"
        value = "" if self.nargs == 0 else f" {values}"
        _warn_of_spelling(f"{self.option_strings[0]}{value}", f"{present}{value}")
        setattr(namespace, self.dest, self.const if self.nargs == 0 else values)


def _warn_of_spelling(old: str, new: str) -> None:
    if is_first_rank(current_ranks()):
        log(f"warning: {old} is deprecated, write {new}")


def make_parser(commands: Mapping[str, Callable[[Any], int]]) -> argparse.ArgumentParser:
    """Return the parser of the command, which stores one of ``commands`` as ``command``."""
    parser = _Parser(prog="warpmag", description="Magnets for the Newton physics engine.", epilog=_epilog(_EXAMPLES))
    parser.add_argument("--version", action="version", version=f"warpmag {__version__}")
    subparsers = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def add(name: str, text: str, examples: str) -> argparse.ArgumentParser:
        described = f"{text[0].upper()}{text[1:]}."
        command = subparsers.add_parser(name, help=text, description=described, epilog=_epilog(examples))
        command.set_defaults(command=commands[name])
        return command

    _add_run(add("run", "simulate a scene and write it as a USD stage", _RUN_EXAMPLES))
    add("scenes", "list the bundled scenes", "\n  warpmag scenes\n")
    text = "list the named materials of magnets"
    add("materials", text, "\n  warpmag materials\n")
    check = add("check", "report the contents and the errors of a stage", "\n  warpmag check lift.usda\n")
    check.add_argument("stage", metavar="STAGE", help=_STAGE)
    _add_render(add("render", "draw frames of a stage or of a finished run", _RENDER_EXAMPLES))
    text = "export a scene or a finished run as a stage for renderers, a web page, or a table of numbers"
    _add_export(add("export", text, _EXPORT_EXAMPLES))
    return parser


def _epilog(examples: str) -> str:
    return f"examples:{examples}"


def _add_run(run: argparse.ArgumentParser) -> None:
    add = run.add_argument
    add("scene", metavar="SCENE", help=_STAGE)
    add("-o", "--output", metavar="OUT", help="USD file to write (default: warpmag_out/SCENE.usda)")
    existing = run.add_mutually_exclusive_group()
    existing.add_argument("--overwrite", action="store_true", help="replace the result of an earlier run")
    existing.add_argument("--resume", action="store_true", help="continue the run at the output, if there is one")
    add("--balls", type=int, metavar="N", help="number of balls of falling_magnet, sakura_tree or million")
    length = run.add_mutually_exclusive_group()
    text = "output frames to simulate (default: the time range of the stage, else 1 s)"
    length.add_argument("--frames", type=int, metavar="N", help=text)
    length.add_argument("--duration", type=float, metavar="S", help="time to simulate [s], in place of --frames")
    add("--step", type=float, metavar="S", help="time step [s] (default: the stage's, else 1e-3)")
    text = "uniform field H0 [A/m] in place of the stage's"
    add("--external-field", type=float, nargs=3, metavar=("HX", "HY", "HZ"), help=text)
    add("--device", help=_DEVICE)
    add("--solver", choices=SOLVERS, default=next(iter(SOLVERS)), help="rigid-body solver (default: %(default)s)")
    text = "force law, dynamics and curve of all magnets, as in this library, Kim and Han 2022, or Kim et al. 2018"
    add("--preset", choices=PRESETS, help=text)
    add("--force", choices=FORCES, help="force law (default: the stage's, else kelvin)")
    add("--dynamics", choices=DYNAMICS, help="magnetization dynamics (default: the stage's, else theta)")
    add("--contact-model", choices=CONTACT_MODELS, help=_CONTACT_MODEL)
    names = f"{{{','.join(METHODS)}}}"
    text = "sums over all pairs (direct), by multipoles (fmm), or the faster of both (default: %(default)s)"
    add("--method", action=_Method, default=METHODS[0], metavar=names, help=text)
    add("--sums", dest="method", action=_Renamed, choices=METHODS, default=METHODS[0], help=argparse.SUPPRESS)
    text = "relative magnetization error at which induction ends, at least 2e-6 (default: the stage's, else 1e-3)"
    add("--rtol", type=float, metavar="X", help=text)
    text = "viewer that shows the run (default: %(default)s)"
    add("--viewer", choices=("none", *VIEWERS), default="none", help=text)
    text = "also write a stage for renderers beside the output, as 'warpmag export' does"
    add("--for", dest="purpose", choices=("render",), help=text)
    add("--verbose", action="store_true", help="also print times per step, field evaluations, moments and buffers")


def _add_render(render: argparse.ArgumentParser) -> None:
    add = render.add_argument
    add("stage", metavar="STAGE", help=_STAGE)
    add(
        "-o",
        "--output",
        metavar="FILE",
        required=True,
        help="picture (.png, .jpg with --quality final) or film (.mp4, .webp, .gif)",
    )
    frames = render.add_mutually_exclusive_group()
    text = "number of the frame to draw, 0 for the start (default: the last)"
    frames.add_argument("--frame", type=int, metavar="N", help=text)
    frames.add_argument("--frames", metavar="A:B", help="first and last frame to draw (default for a film: all)")
    add("--size", metavar="WxH", default="960x540", help="width and height [px] (default: %(default)s)")
    text = "draft by ray tracing, or final by Blender's path tracer (default: %(default)s)"
    add("--quality", choices=("draft", "final"), default="draft", help=text)
    add("--arrows", action="store_true", help="draw the moments of a finished run as arrows")
    add("--moments", dest="arrows", action=_Renamed, nargs=0, const=True, help=argparse.SUPPRESS)
    text = "path of a camera, or auto for a view of all bodies (default: the first camera, auto if it sees no body)"
    add("--camera", metavar="PATH", help=text)
    add("--device", help=_DEVICE)


def _add_export(export: argparse.ArgumentParser) -> None:
    add = export.add_argument
    add("stage", metavar="STAGE", help=_STAGE)
    text = "file: .usda, .usdc or .usdz for renderers, .html for a web page, .npz or .csv for numbers"
    add("-o", "--output", metavar="OUT", required=True, help=text)
    text = "frames per second (default: %(default)g, as in Blender)"
    add("--fps", type=float, default=24.0, metavar="HZ", help=text)
    add("--rate", dest="fps", action=_Renamed, type=float, default=24.0, help=argparse.SUPPRESS)
    add("--color", metavar="QUANTITY", help="color bodies by magnetization, speed or force")
    add("--arrows", action="store_true", help="draw moments as arrows")
    add("--field-lines", type=int, default=0, metavar="N", help="draw N field lines of the permanent magnets")
    add("--materialx", action="store_true", help="also write materials as MaterialX")
    add("--device", help=_DEVICE)
