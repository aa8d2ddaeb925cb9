"""Fig. 10: magnetic force field over the cross-section of a uniformly magnetized sphere, both force laws.

The paper states neither sizes nor the body on which the force acts. Two readings are evaluated:

- inside: the sphere is inducible, sampled by a cubic lattice of moments, and a uniform field magnetizes it. The figure
  shows the force density on the moments of the middle layer. The gradient is due to the lattice and the surface only,
  since the field inside a uniformly magnetized sphere is uniform;
- outside: the sphere is a permanent magnet, and the force acts on a small inducible ball at each point around it.
"""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.patches import Circle

from bench.paper.output import Output, table
from bench.systems import moment_system
from warpmag.declarations.magnets import SATURATION_OF_IRON
from warpmag.moments.system import MomentSystem
from warpmag.shapes import lattice

RADIUS = 0.02  # radius of the sphere [m]
BALL_RADIUS = 0.0005  # radius of the small ball outside [m]
LAWS = {"kelvin": "(a) Kim et al. 2018 (Kelvin, Eq. 13)", "zeeman": "(b) the paper (Zeeman, Eq. 4)"}
LEVELS = {"weak": 0.1, "strong": 0.99}
"""Magnetization of the sphere over Ms: weak, and close to saturation."""


def run(output: Output):
    """Run the experiment."""
    figure, axes = plt.subplots(4, 3, figsize=(13.5, 16.0), layout="constrained")
    rows = []
    readings = [(reading, level) for reading in (_inside, _outside) for level in LEVELS]
    for row, (reading, level) in zip(axes, readings, strict=True):
        name = reading.__name__.strip("_")
        points, densities, pitch = reading(LEVELS[level], output)
        sizes = {law: np.linalg.norm(density, axis=1) for law, density in densities.items()}
        _draw_row(row, f"{name}, {level} magnet", points, densities, sizes, pitch)
        significant = sizes["kelvin"] > 1e-3 * sizes["kelvin"].mean()  # the force in the middle is rounding
        ratio = sizes["zeeman"][significant] / sizes["kelvin"][significant]
        values = {
            "mean_kelvin": float(sizes["kelvin"].mean()),
            "mean_zeeman": float(sizes["zeeman"].mean()),
            "smallest_ratio": float(ratio.min()),
            "median_ratio": float(np.median(ratio)),
            "largest_ratio": float(ratio.max()),
        }
        output.record(reading=name, magnetization=LEVELS[level], points=len(points), **values)
        rows.append([name, f"{LEVELS[level]:g} Ms", *(f"{value:.3g}" for value in values.values())])
    output.report(_text(output.save(figure), rows))
    plt.close(figure)


def _inside(level: float, output: Output):
    """Return points [m] of the middle layer, force densities [N/m³] by law, and the distance of points [m]."""
    count = 11 if output.small else 21
    pitch = 2.0 * RADIUS / count
    index = np.arange(count) - (count - 1) / 2.0
    cells = np.stack(np.meshgrid(index, index, index, indexing="ij"), axis=-1).reshape(-1, 3)
    positions = pitch * cells[np.linalg.norm(cells, axis=1) <= 0.5 * count]
    volume = pitch**3
    # the applied field that magnetizes a sphere to this level: inside, H = H0 − M/3, and a moment sees H0
    applied = SATURATION_OF_IRON * np.arctanh(level) / 3.0
    system = moment_system(
        radii=np.full(len(positions), (0.75 * volume / np.pi) ** (1.0 / 3.0)),
        saturation=SATURATION_OF_IRON,
        external_field=(applied, 0.0, 0.0),
        rtol=1e-4,
        device=output.device,
    )
    system.positions.assign(positions)
    system.solve()
    middle = np.abs(positions[:, 2]) < 0.5 * pitch
    return positions[middle], _densities(system, middle, volume), pitch


def _outside(level: float, output: Output):
    """Return points [m] around the magnet, force densities [N/m³] by law, and the distance of points [m].

    Every ball is alone with the magnet in a world, so balls do not act on each other. A uniformly magnetized sphere is
    exactly one ball-averaged moment.
    """
    count = 31 if output.small else 61
    index = np.linspace(-2.5 * RADIUS, 2.5 * RADIUS, count)
    points = np.stack(np.meshgrid(index, index, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    points = points[np.linalg.norm(points, axis=1) > RADIUS + BALL_RADIUS]
    n = len(points)
    system = moment_system(
        worlds=np.repeat(np.arange(n), 2),
        permanent=np.tile([False, True], n),
        radii=np.tile([BALL_RADIUS, RADIUS], n),
        saturation=SATURATION_OF_IRON,
        rtol=1e-4,
        device=output.device,
    )
    positions, moments = np.zeros((2 * n, 3)), np.zeros((2 * n, 3))
    positions[::2] = points
    moments[1::2, 0] = level * SATURATION_OF_IRON * 4.0 / 3.0 * np.pi * RADIUS**3
    system.positions.assign(positions)
    system.moments.assign(moments)
    system.solve()
    return points, _densities(system, np.arange(0, 2 * n, 2), lattice.ball(BALL_RADIUS).volumes[0]), index[1] - index[0]


def _densities(system: MomentSystem, chosen, volume: float) -> dict[str, np.ndarray]:
    densities = {}
    for law in LAWS:
        system.apply_forces(law)
        densities[law] = system.forces.numpy()[chosen].astype(float) / volume
    return densities


def _draw_row(row, title, points, densities, sizes, pitch):
    both = np.concatenate(list(sizes.values()))
    norm = LogNorm(max(both.min(), 1e-3 * both.max()), both.max())
    for axis, law in zip(row, LAWS, strict=False):
        _draw(axis, points, sizes[law], pitch, norm, "force density [N/m³]")
        unit = densities[law] / np.maximum(sizes[law], 1e-300)[:, None]
        sparse = slice(None, None, max(1, len(points) // 400))
        axis.quiver(*points[sparse, :2].T, *unit[sparse, :2].T, scale=45, width=0.002, color="k", alpha=0.6)
        axis.set_title(f"{LAWS[law]}\n{title}", fontsize=9)
    _draw(row[2], points, sizes["zeeman"] / sizes["kelvin"], pitch, Normalize(1.0, 8.0), "ratio")
    row[2].set_title(f"Zeeman over Kelvin\n{title}", fontsize=9)


def _draw(axis, points, values, pitch, norm, label):
    corner = points[:, :2].min(axis=0)
    cells = np.round((points[:, :2] - corner) / pitch).astype(int)
    shown = np.full(cells.max(axis=0) + 1, np.nan)
    shown[tuple(cells.T)] = values
    edges = [corner[k] + pitch * (np.arange(shown.shape[k] + 1) - 0.5) for k in (0, 1)]
    image = axis.pcolormesh(*edges, shown.T, cmap="rainbow", norm=norm, rasterized=True)
    axis.add_patch(Circle((0.0, 0.0), RADIUS, fill=False, ec="k", lw=0.8))
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])
    axis.figure.colorbar(image, ax=axis, label=label, shrink=0.9)


def _text(image, rows) -> str:
    head = ["forces", "magnetization of the sphere", "mean Kelvin [N/m³]", "mean Zeeman [N/m³]"]
    ratios = [f"{which} ratio Zeeman/Kelvin" for which in ("smallest", "median", "largest")]
    return f"""## Fig. 10: force field of a spherical magnet

**Paper:** inside a uniformly magnetized sphere, "the forces generated by the method of Kim et al. [2018] (a) are
stronger than those generated by our method (b)".

**Here the opposite holds.** Kim et al. 2018 use Kelvin's force (Eq. 13). The paper uses the force of the Zeeman energy
(Eq. 4), which is Kelvin's force plus μ0 V f'(H) ∇H (2M + H). The added term never opposes Kelvin's force. The sum is up
to eight times Kelvin's force in weak fields, and equals it where the body is saturated and f' vanishes.

The paper does not state on which body the force acts, so there are two cases. "Inside" lists forces on the moments of
an inducible sphere (radius {1e3 * RADIUS:g} mm) in a uniform field. "Outside" lists forces on a small inducible ball
(radius {1e3 * BALL_RADIUS:g} mm) near a permanent sphere. In the figure, "weak" and "strong" are the two
magnetizations of the table. The magnetization is horizontal, and both laws share a color scale.

{image}

{table([*head, *ratios], rows)}"""
