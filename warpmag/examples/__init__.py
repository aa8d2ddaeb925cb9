"""Examples in the pattern of Newton's: ``python -m warpmag.examples NAME``.

Each is a module with a class ``Example``: the constructor builds the scene, ``step`` advances one frame, ``render``
shows it, ``test_final`` compares the result with physics, ``summary`` returns a line about it. ``--test`` calls
``test_final`` at the end, ``--describe`` also prints the comparison, ``--headless`` draws nothing. May import
``moments`` and ``show``.
"""

import argparse
import ast
import importlib
import inspect
import sys
from pathlib import Path

import newton.examples
import warp as wp

from warpmag.errors import InputError, extra, one_line
from warpmag.moments.arrays import resolve_device
from warpmag.show.viewers import no_viewer
from warpmag.terminal import log, quiet_warp, silence

__all__ = ["create_parser", "get_examples", "init", "main", "run"]


def create_parser(frames: int) -> argparse.ArgumentParser:
    """Return Newton's parser of the options that all examples take.

    Args:
        frames: Default of ``--num-frames``.
    """
    parser = newton.examples.create_parser()
    parser.set_defaults(num_frames=frames)
    for action in parser._actions:
        if action.dest == "headless":
            action.help = "Draw nothing, as --viewer null."
    parser.add_argument("--describe", action="store_true", help="Print what the example shows and checks; as --test.")
    return parser


def init(parser: argparse.ArgumentParser):
    """Parse the options and open the viewer.

    Returns:
        The viewer and the options.

    Raises:
        InputError: There is no such device, or the viewer cannot open.
    """
    options = parser.parse_args()
    if options.device:
        resolve_device(options.device)
    if options.headless:
        sys.argv += ["--viewer", "null"]
    level = max(wp.config.log_level, wp.LOG_WARNING)
    quiet_warp()
    wp.config.log_level = level  # keeps warnings of Warp, which are useful to learners
    try:
        return newton.examples.init(parser)
    except Exception as error:  # each viewer fails in its own way
        raise no_viewer(options.viewer, error) from None


def run(example, options) -> None:
    """Run an example to its end and print its summary.

    With ``--describe`` also print its description and its check.

    Raises:
        AssertionError: With ``--test`` or ``--describe``, the result does not agree with physics.
    """
    if options.describe:
        options.test = True
        print(_paragraph(sys.modules[type(example).__module__]), "\n")
        print(_paragraph(type(example).test_final), flush=True)
    newton.examples.run(example, options)
    print(f"Passed: {example.summary()}" if options.describe else example.summary())


def _paragraph(item) -> str:
    """Return the docstring of a module or a function, without the line of its command."""
    return (inspect.getdoc(item) or "").partition("\n\nRuns: ")[0].strip()


def get_examples() -> dict[str, str]:
    """Return the first line of each example's docstring, by its name."""
    lines = {}
    for path in sorted(Path(__file__).parent.glob("*.py")):
        if not path.stem.startswith("_"):
            text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            lines[path.stem] = text.partition("\n")[0]
    return lines


def main() -> int:
    """Run the example named on the command line, or list all examples; return the exit code, with one line why."""
    try:
        code = _execute()
        sys.stdout.flush()
    except InputError as error:
        log(error)
        return 2
    except OSError as error:  # a full disk, or a closed standard output
        silence(1)
        log(one_line(str(error)))
        return 1
    return code


def _execute() -> int:
    examples = get_examples()
    name = sys.argv[1] if len(sys.argv) > 1 else None
    if name in examples:
        sys.argv = [f"warpmag.examples.{name}", *sys.argv[2:]]
        try:
            example = importlib.import_module(sys.argv[0]).Example
            viewer, options = init(example.create_parser())
            run(example(viewer, options), options)
        except AssertionError as error:  # of ``test_final``
            log(f"{name}: the check failed: {one_line(str(error))}")
            return 1
        except ImportError as error:  # a solver of Newton, whose message names the package
            raise InputError(f"{name} needs {extra('sim')}: {one_line(str(error.__cause__ or error))}") from error
        return 0
    if name not in (None, "-h", "--help", "--list"):
        raise InputError(f"{one_line(repr(name))}: no such example, there are {', '.join(examples)}")
    print("python -m warpmag.examples NAME [--describe] [--headless] [--viewer gl|viser|usd|null] [--device cuda:0]")
    width = max(map(len, examples))
    for example, line in examples.items():
        print(f"  {example:{width}}  {line}")
    return 0
