"""A magnetometer on a Newton model, after ``newton.sensors``."""

import fnmatch
import math
import re

import newton
import numpy as np
import warp as wp

from warpmag.declarations.checks import check_not_negative, check_positive, check_whole, short_repr
from warpmag.engine.magnets.caller_checks import check_state
from warpmag.engine.magnets.magnetics import Magnetics, check_magnetics
from warpmag.errors import InputError
from warpmag.kernels.rigid.sources import Sites, find_sites, read_sites


class SensorMagnetometer:
    """Magnetometers at sites of a model, such as compasses and Hall sensors: flux density in the frames of the sites.

    The readings include the external field and all magnets of the world, also magnets of the sensor's own body.

    Attributes:
        flux_density: Readings B [T] in the frames of the sites, vectors on the device, shape [s].
        sites: Shape indices of the sites, [s].

    Example:
        >>> import newton
        >>> import warpmag
        >>> builder = newton.ModelBuilder()
        >>> warpmag.register_custom_attributes(builder)
        >>> magnet = builder.add_body()
        >>> shape = builder.add_shape_sphere(magnet, radius=0.01)
        >>> marked = warpmag.add_permanent(builder, body=magnet, magnetization=(0.0, 0.0, 9e5))
        >>> site = builder.add_site(-1, xform=((0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)), label="compass")
        >>> model = builder.finalize(device="cpu")
        >>> magnetics, state = warpmag.Magnetics(model), model.state()
        >>> magnetics.apply(state)
        >>> compass = warpmag.SensorMagnetometer(model, magnetics, sites="compass*")
        >>> compass.update(state)
        >>> round(float(compass.flux_density.numpy()[0, 2]), 6)  # T: μ0 m/(2π d³)
        0.000754
    """

    def __init__(
        self,
        model: newton.Model,
        magnetics: Magnetics,
        sites: str | list[str] | re.Pattern[str] | list[int],
        *,
        noise: float = 0.0,
        saturation: float = math.inf,
        seed: int = 0,
    ):
        """Find the sites and allocate all buffers.

        Args:
            model: The model.
            magnetics: Its magnets.
            sites: Shell pattern of labels, list of patterns, regular expression for whole labels, or list of shape
                indices.
            noise: Standard deviation of Gaussian noise on each component [T].
            saturation: Largest magnitude of a component of a reading [T].
            seed: Seed of the noise.

        Raises:
            InputError: No site matches, a match is not a site, the world of a site holds no magnets, or a number is out
                of range.
        """
        check_magnetics(magnetics, model)
        check_not_negative("noise", noise)
        check_whole("seed", seed)
        check_positive("saturation", saturation, infinite=True)
        self.sites, self._model = _find_sites(model, sites), model
        self._noise, self._saturation, self._seed = float(noise), float(saturation), int(seed)
        worlds = np.maximum(model.shape_world.numpy()[self.sites], 0) if model.world_count > 1 else None
        self._probe = magnetics.probe(np.zeros((len(self.sites), 3)), worlds=worlds)
        device = wp.get_device(model.device)
        self._sites = Sites()
        self._sites.shape = wp.array(self.sites, dtype=wp.int32, device=device)
        self._sites.shape_body, self._sites.shape_frames = model.shape_body, model.shape_transform
        self._count = wp.zeros(1, dtype=wp.int32, device=device)
        self.flux_density = wp.zeros(len(self.sites), dtype=wp.vec3, device=device)

    def update(self, state: newton.State) -> None:
        """Read the sensors at the poses of ``state``; capturable in a graph.

        Args:
            state: State with poses ``body_q``. The last :meth:`Magnetics.apply` has set the magnetizations.
        """
        check_state(state, self._model, "body_q")
        find_sites(state.body_q, self._sites, self._probe.points)
        self._probe.measure()
        read_sites(
            state.body_q, self._sites, self._probe.b, noise=self._noise, limit=self._saturation, seed=self._seed,
            reading_count=self._count, readings=self.flux_density,
        )  # fmt: skip


def _find_sites(model: newton.Model, sites) -> list[int]:
    """Return the shape indices of the sites, in the order of the model or of the list of indices."""
    flags = model.shape_flags.numpy()
    if isinstance(sites, list) and sites and not isinstance(sites[0], str):
        for index in sites:
            check_whole("sites", index)
            if not 0 <= index < model.shape_count or not flags[index] & newton.ShapeFlags.SITE:
                raise InputError(f"sites: {short_repr(index)} is not a site")
        return [int(index) for index in sites]
    if isinstance(sites, re.Pattern):
        matches = sites.fullmatch
    else:
        patterns = [sites] if isinstance(sites, str) else sites
        if not isinstance(patterns, list | tuple) or not all(isinstance(pattern, str) for pattern in patterns):
            raise InputError(f"sites: must be patterns of labels or a list of shapes, got {short_repr(sites)}")
        matches = re.compile("|".join(fnmatch.translate(pattern) for pattern in patterns) or r"(?!)").match
    indices = [index for index, label in enumerate(model.shape_label[: model.shape_count]) if matches(label)]
    for index in indices:
        if not flags[index] & newton.ShapeFlags.SITE:
            raise InputError(f"sites: {model.shape_label[index]} is not a site")
    if not indices:
        raise InputError(f"sites: no label matches {short_repr(getattr(sites, 'pattern', sites))}")
    return indices
