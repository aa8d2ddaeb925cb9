"""Errors and warnings of the library."""

_BEGIN, _END = 400, 200
"""Characters of a message that are kept, where names in it have hundreds of thousands."""


def one_line(text: str) -> str:
    """Return a text as one line that a terminal shows as it is, its middle left out where it is very long."""
    if len(text) > _BEGIN + _END:  # first of all: of a gigabyte the characters one by one are more than memory holds
        text = f"{text[:_BEGIN]} ... {text[-_END:]}"
    return "".join(one if one.isprintable() else " " for one in text)


def extra(name: str) -> str:
    """Return the extra of that name with the commands that bring it, for a line about what is missing."""
    return f"the extra '{name}' (in a checkout pip install '.[{name}]', or uv run --extra {name} ...)"


class InputError(ValueError):
    """Bad input from the user: one line that names the prim or the argument.

    The command prints it and exits with code 2; at the array and Newton level it is an ordinary ``ValueError``.
    """

    def __init__(self, message: str):
        """Make one line of ``message``."""
        super().__init__(one_line(str(message)))


class SimulationError(RuntimeError):
    """A simulation that cannot go on: one line that names the step and the body."""

    def __init__(self, message: str):
        """Make one line of ``message``."""
        super().__init__(one_line(str(message)))


class ConvergenceWarning(UserWarning):
    """An induction solve that gave up before its tolerance."""
