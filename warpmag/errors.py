"""Errors and warnings of the library."""


class InputError(ValueError):
    """Bad input from the user: one line that names the prim or the argument.

    The command prints it and exits with code 2; at the array and Newton level it is an ordinary ``ValueError``.
    """


class SimulationError(RuntimeError):
    """A simulation that cannot go on: one line that names the step and the body."""


class ConvergenceWarning(UserWarning):
    """An induction solve that gave up before its tolerance."""
