"""Bodies and shapes of a Newton builder, selected by index, by label or by a pattern of labels."""

import difflib
from collections.abc import Sequence
from fnmatch import fnmatchcase

from warpmag.declarations.checks import check_whole, short_repr
from warpmag.errors import InputError

_WILDCARDS = "*?["
_MOST_LISTED = 3  # labels in a message
MESH_SUFFIX = "_drawn"
"""Suffix of the label of a mesh that is a magnet in place of its simplified collider."""


def prim_label(shape: int, labels: Sequence[str]) -> str:
    """Return the label of a shape, or that of its collider if the shape is a mesh with ``MESH_SUFFIX``.

    The label of the collider is the path of the mesh on the stage.
    """
    label = labels[shape]
    collider = label.removesuffix(MESH_SUFFIX)
    return collider if collider != label and collider in labels else label


def selected(name: str, wanted: int | str, labels: Sequence[str], noun: str) -> list[int]:
    """Return the indices of a builder's objects that an argument selects, at least one.

    Args:
        name: The argument, for messages.
        wanted: An index; or a label, whole or the part after its last ``/``; or a pattern with ``*``, ``?`` or
            ``[...]``, which may select several objects.
        labels: Label of each object.
        noun: Noun of the objects, for messages.

    Raises:
        InputError: The index is out of range, no label is equal or matches, or a label is that of several objects.
    """
    if not isinstance(wanted, str):
        check_whole(name, wanted)
        if not 0 <= wanted < len(labels):
            raise InputError(f"{name}: {short_repr(wanted)} is out of range, the builder has {len(labels)} {noun}")
        return [int(wanted)]
    if any(character in wanted for character in _WILDCARDS):
        matches = [index for index, label in enumerate(labels) if fnmatchcase(label, wanted)]
        if not matches:
            raise _unknown(name, wanted, labels, noun)
        return matches
    for part_of in (str, lambda label: label.rpartition("/")[2]):
        matches = [index for index, label in enumerate(labels) if part_of(label) == wanted]
        if len(matches) > 1:
            listed = ", ".join(f"{labels[index]!r} ({index})" for index in matches[:_MOST_LISTED])
            clash = f"{short_repr(wanted)} is the label of {len(matches)} {noun}: {listed}"
            raise InputError(f"{name}: {clash}; give an index or a pattern")
        if matches:
            return matches
    raise _unknown(name, wanted, labels, noun)


def _unknown(name: str, wanted: str, labels: Sequence[str], noun: str) -> InputError:
    """Return the error of a label that nothing has, with the labels that are most like it."""
    ends = {label.rpartition("/")[2]: label for label in labels}
    like = [ends[end] for end in difflib.get_close_matches(wanted.rpartition("/")[2], ends, _MOST_LISTED)]
    known = ", ".join(map(repr, like or labels[:_MOST_LISTED])) or "none"
    return InputError(
        f"{name}: no label of the builder's {len(labels)} {noun} matches {short_repr(wanted)}; such as {known}"
    )
