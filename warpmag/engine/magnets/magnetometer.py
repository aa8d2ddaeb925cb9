"""A magnetometer on a Newton model, after ``newton.sensors``."""

import fnmatch
import math
import re

import newton
import numpy as np
import warp as wp

from warpmag.declarations.checks import check_not_negative, check_whole, short_repr
from warpmag.engine.magnets.magnetics import Magnetics
from warpmag.errors import InputError
from warpmag.kernels.rigid.sites import Sites, find_sites, read_sites


class SensorMagnetometer:
    """Measures flux density at sites of a model, in their frames: a compass, a Hall sensor.

    ::

        builder.add_site(body, label="compass")
        ...
        magnetometer = warpmag.SensorMagnetometer(model, magnetics, sites="compass*", noise=1e-7)
        magnetics.apply(state)
        magnetometer.update(state)
        flux_density = magnetometer.flux_density.numpy()

    It sees the external field and all magnets of its world, those of its own body, too.

    Attributes:
        flux_density: Readings B [T] in the frames of the sites, shape [s].
        sites: Shapes that are the sites, [s].
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
        """Find the sites and allocate everything that :meth:`update` needs.

        Args:
            model: The model.
            magnetics: Its magnets.
            sites: Pattern of labels as in a shell, several, a regular expression that matches whole labels, or indices.
            noise: Standard deviation of Gaussian noise on each component [T].
            saturation: Largest size of a component that is read [T].
            seed: Seed of the noise.

        Raises:
            InputError: No site is found, something else than a site is, a site's world holds no magnets, or a number is
                out of range.
        """
        check_not_negative("noise", noise)
        check_whole("seed", seed)
        if not saturation > 0.0:
            raise InputError(f"saturation: must be positive, got {short_repr(saturation)}")
        self.sites = _find_sites(model, sites)
        self._noise, self._most, self._seed = float(noise), float(saturation), int(seed)
        worlds = np.maximum(model.shape_world.numpy()[self.sites], 0) if model.world_count > 1 else None
        self._probe = magnetics.probe(np.zeros((len(self.sites), 3)), worlds=worlds)
        device = wp.get_device(model.device)
        self._sites = Sites()
        self._sites.shape = wp.array(self.sites, dtype=wp.int32, device=device)
        self._sites.shape_body, self._sites.shape_frames = model.shape_body, model.shape_transform
        self._count = wp.zeros(1, dtype=wp.int32, device=device)
        self.flux_density = wp.zeros(len(self.sites), dtype=wp.vec3, device=device)

    def update(self, state: newton.State) -> None:
        """Read the sensors at the poses of ``state``, of moments as :meth:`Magnetics.apply` left them; capturable."""
        find_sites(state.body_q, self._sites, self._probe.points)
        self._probe.measure()
        read_sites(
            state.body_q,
            self._sites,
            self._probe.b,
            noise=self._noise,
            most=self._most,
            seed=self._seed,
            reading_count=self._count,
            readings=self.flux_density,
        )


def _find_sites(model: newton.Model, wanted) -> list[int]:
    """Return the sites of ``model`` that are wanted, in its order, or as they are listed."""
    flags = model.shape_flags.numpy()
    if isinstance(wanted, list) and wanted and not isinstance(wanted[0], str):
        for index in wanted:
            check_whole("sites", index)
            if not 0 <= index < model.shape_count or not flags[index] & newton.ShapeFlags.SITE:
                raise InputError(f"sites: {short_repr(index)} is no site")
        return [int(index) for index in wanted]
    if isinstance(wanted, re.Pattern):
        matches = wanted.fullmatch
    else:
        patterns = [wanted] if isinstance(wanted, str) else list(wanted)
        matches = re.compile("|".join(fnmatch.translate(pattern) for pattern in patterns) or r"(?!)").match
    found = [index for index, label in enumerate(model.shape_label) if matches(label)]
    for index in found:
        if not flags[index] & newton.ShapeFlags.SITE:
            raise InputError(f"sites: {model.shape_label[index]} is no site")
    if not found:
        raise InputError(f"sites: no label matches {short_repr(getattr(wanted, 'pattern', wanted))}")
    return found
