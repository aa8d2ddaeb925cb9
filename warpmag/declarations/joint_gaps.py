"""When the ends of a joint count as apart at the start, on stages and in models, and what the user is told of it."""

_APART, _ROUNDING = 1e-4, 1e-5
"""How far apart they may be [m], and in parts of their coordinates: poses are often single precision."""


def are_apart(gap, distance):
    """Whether ends so far from each other, at such a distance from the origin [m], are; numbers or arrays of them."""
    return gap > _APART + _ROUNDING * distance


def told(gap: float) -> str:
    """Return what a run makes of ends that are so far apart [m]."""
    return f"{gap:.3g} m apart at the start, and a run begins by pulling"
