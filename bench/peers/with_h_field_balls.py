"""warpmag.h_field of balls that nearly touch."""

from functools import partial

from bench.cases import RADIUS
from bench.peers import with_h_field

prepare = partial(with_h_field.prepare, radii=0.9 * RADIUS)
