"""Time and error over the number of moments, by all pairs and by the fast multipole method: ``python -m bench.many``.

The timed quantities are the field, and the force with torque, of moments of random directions in a jittered cubic
lattice that fills a cube. Data are on the device, and times include building the cells. Errors at some moments are
relative to float64 sums over all pairs. Each measurement is one JSON line; ``--draw`` draws such lines.

Peers are fast multipole methods for dipoles or, in libraries without dipoles, for point charges, which are cheaper.
Errors of the latter are relative to sums over all pairs of charges.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp

from bench.compare import compare, errors
from bench.machine import line_writer
from bench.peers import PEERS, Peer
from bench.report import machine_of, read
from bench.timing import measure
from warpmag.kernels.pairs.evaluate import PairEvaluation
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.moments.fmm import FastSums
from warpmag.moments.ranks import current_ranks

SIZES = {
    "cpu": (1_000, 2_197, 4_913, 10_648, 21_952, 50_653, 97_336),
    "cuda": (1_000, 4_913, 10_648, 21_952, 32_768, 50_653, 97_336, 205_379, 512_000, 1_000_000, 2_048_383, 4_019_679),
}
RTOLS = (None, 1e-3, 1e-5)  # requested relative errors; None means all pairs
_SPACING = 0.005  # lattice spacing [m]
_CHECKED = 100  # number of moments at which errors are measured


class Moments:
    """Moments on a device, and the arrays of their sums."""

    def __init__(self, positions, moments, dtype, device):
        """Copy positions [m] and moments [A·m²], shape [n, 3], to the device."""
        n, vec3 = len(positions), wp.types.vector(3, dtype)
        x, m = (wp.array(values, dtype=vec3, device=device) for values in (positions, moments))
        self.packed = PackedMoments(wp.zeros(n, dtype=dtype, device=device), largest_radius=0.0, moving=False)
        self.packed.pack(x, m)
        self._base, self.out, self._torques = (wp.zeros_like(x) for _ in range(3))
        self._with_torque = wp.ones(n, dtype=int, device=device)

    def evaluation(self, quantity: Quantity, rows=None, sums=None) -> PairEvaluation:
        """Evaluation of a quantity into ``out``: at some rows only, or by ``sums`` in place of all pairs."""
        n = self.packed.count
        segments = [(0, n, 0, n)] if rows is None else [(row, row + 1, 0, n) for row in rows]
        return PairEvaluation(
            quantity, segments, self.packed, self.packed, self._base, self.out, with_torque=self._with_torque,
            torques=self._torques, sums=sums, ranks=current_ranks(),
        )  # fmt: skip

    def values(self, quantity: Quantity, rows) -> np.ndarray:
        """Sums over all pairs at some rows, shape [rows, 3]."""
        self.evaluation(quantity, rows).launch()
        return self.out.numpy()[rows]

    def parts(self, quantity: Quantity, rtol: float | None) -> tuple[Callable[[], None], Callable[[], None]]:
        """Functions that build the cells of moments that have moved, and that evaluate a quantity into ``out``.

        If ``rtol`` is None there are no cells, and the evaluation sums over all pairs.
        """
        if rtol is None:
            return (lambda: None), self.evaluation(quantity).launch
        fast = FastSums(self.packed, rtol)
        return fast.build, self.evaluation(quantity, sums=fast.sums(quantity)).launch


def repetitions(count: int) -> dict:
    """Arguments of ``measure`` for a number of moments: few repetitions where the launch of a graph is negligible."""
    return {"repeats": 2, "chained": 1} if count > 200_000 else {}


def lattice(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions [m] and moments [A·m²] of the first ``count`` sites, the same in every run, float32, shape [n, 3]."""
    random, side = np.random.default_rng(1), int(np.ceil(count ** (1 / 3) - 1e-9))
    sites = np.stack(np.meshgrid(*3 * [np.arange(side)], indexing="ij"), axis=-1).reshape(-1, 3)[:count]
    positions = _SPACING * (sites + random.uniform(-0.15, 0.15, sites.shape))
    return positions.astype(np.float32), random.normal(size=sites.shape).astype(np.float32)


def _checked_rows(count: int) -> np.ndarray:
    return np.sort(np.random.default_rng(2).choice(count, min(_CHECKED, count), replace=False))


def run_size(count: int, device, slowest: float, seconds: dict):
    """Yield the values of each quantity and method at one size.

    ``seconds`` are the times of all pairs by quantity and count, to which measured times are added. Sums over all pairs
    are skipped if the time [s] expected from them is longer than ``slowest``.
    """
    positions, moments = lattice(count)
    rows = _checked_rows(count)
    exact = Moments(positions.astype(float), moments.astype(float), wp.float64, device)
    single = Moments(positions, moments, wp.float32, device)
    for quantity in (Quantity.FIELD, Quantity.WRENCH):
        expected = exact.values(quantity, rows)
        forecasts = [t * (count / n) ** 2 for (q, n), t in seconds.items() if q == quantity]
        for rtol in RTOLS:
            if rtol is None and min(forecasts, default=0.0) > slowest:
                continue
            began = time.perf_counter()
            build, evaluate = single.parts(quantity, rtol)

            def work(build=build, evaluate=evaluate):
                build()
                evaluate()

            work()
            wp.synchronize_device(device)
            first = time.perf_counter() - began
            elapsed = measure(work, device, **repetitions(count))
            if rtol is None:
                seconds[quantity, count] = elapsed
            line = {"quantity": quantity.name.lower(), "method": "direct" if rtol is None else "fmm", "rtol": rtol}
            line |= {"count": count, "seconds": elapsed, **errors(single.out.numpy()[rows], expected)}
            yield line | {"first_call_seconds": first}


def run_peer(peer: Peer, count: int, device) -> dict:
    """Values of a peer at one size; ``failed`` if the peer fails or its library is missing."""
    positions, moments = lattice(count)
    rows = _checked_rows(count)
    if peer.charges:
        strengths = np.ascontiguousarray(moments[:, 0])
        expected = field_of_charges(positions, strengths, rows)
    else:
        strengths, exact = moments, Moments(positions.astype(float), moments.astype(float), wp.float64, device)
        expected = exact.values(Quantity.FIELD, rows)
    line = {"quantity": "field", "method": peer.name, "rtol": None, "count": count}
    return line | compare([peer], positions, strengths, (rows, expected), str(device), 1.0)[peer.name]


def field_of_charges(positions, charges, rows) -> np.ndarray:
    """Field Σ q r / 4π|r|³ at some of the charges, shape [rows, 3]."""
    x, q, fields = positions.astype(float), charges.astype(float), []
    for row in rows:
        r = x[row] - x
        cubes = (r**2).sum(axis=1) ** 1.5
        cubes[row] = np.inf
        fields.append((q / cubes) @ r / (4.0 * np.pi))
    return np.array(fields)


def draw(lines, path: Path) -> None:
    """Draw time and error over the number of moments."""
    import matplotlib  # noqa: PLC0415 - only drawing needs it

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt  # noqa: PLC0415

    figure, (times, accuracy) = plt.subplots(2, 1, figsize=(6.3, 7.6), layout="constrained")
    series: dict[tuple, list] = {}
    for line in sorted((line for line in lines if "seconds" in line), key=lambda line: line["count"]):
        series.setdefault((line["method"], line["rtol"], line["quantity"]), []).append(line)
    methods = sorted({key[:2] for key in series}, key=lambda m: (m[0] not in ("direct", "fmm"), m[0], -(m[1] or 1.0)))
    colors = dict(zip(methods, plt.rcParams["axes.prop_cycle"].by_key()["color"], strict=False))
    words = {"direct": "all pairs", "fmm": "multipoles", "field": "field", "wrench": "force, torque"}
    for (method, rtol, quantity), points in series.items():
        style = {"color": colors[method, rtol], "linestyle": "-" if quantity == "field" else "--", "marker": "."}
        label = f"{words.get(method, method)}{f', rtol {rtol:g}' if rtol else ''}: {words[quantity]}"
        counts = [line["count"] for line in points]
        times.plot(counts, [1e3 * line["seconds"] for line in points], label=label, **style)
        accuracy.plot(counts, [line["error"] for line in points], **style)
    times.legend(fontsize="small", handlelength=3.5)  # long enough for two dashes
    for axis, quantity in ((times, "time [ms]"), (accuracy, "relative error")):
        axis.set(xscale="log", yscale="log", xlabel="moments", ylabel=quantity)
        axis.grid(True, alpha=0.3)
    figure.suptitle(f"{machine_of(lines[0])}, commit {lines[0]['commit']}")
    figure.savefig(path, dpi=160, pil_kwargs={"optimize": True})
    plt.close(figure)


def main(arguments=None) -> None:
    """Measure, or draw measured lines."""
    fast = {peer.name: peer for peer in PEERS if peer.charges or peer.name == "fmm3d"}
    parser = argparse.ArgumentParser(prog="python -m bench.many", description=__doc__.partition("\n")[0])
    add = parser.add_argument
    add("--device", default="cpu")
    add("--sizes", type=int, nargs="+", help="numbers of moments; default by device")
    add("--peers", nargs="*", choices=fast, default=(), help="besides warpmag; default: none")
    add("--slowest", type=float, default=2.0, help="seconds beyond which all pairs and peers get no larger sizes (2)")
    add("--draw", type=Path, nargs="+", help="draw these files instead of measuring")
    add("-o", "--output", type=Path, help="file that lines are appended to, or the picture")
    options = parser.parse_args(arguments)
    if options.draw:
        keys = ("method", "rtol", "quantity", "count")
        latest = {tuple(line[key] for key in keys): line for line in read(options.draw)}
        draw(list(latest.values()), options.output or Path("bench_out/many.png"))
        return
    wp.config.log_level = wp.LOG_WARNING
    device, seconds = wp.get_device(options.device), {}
    kind, write = "cpu" if device.is_cpu else "cuda", line_writer(device, options.output)
    peers = [fast[name] for name in options.peers if kind in fast[name].devices]

    for count in options.sizes or SIZES[kind]:
        for line in run_size(count, device, options.slowest, seconds):
            write({"case": "many"} | line)
        for peer in list(peers):
            line = run_peer(peer, count, device)
            write({"case": "many"} | line)
            if "failed" in line:
                print(f"{line['method']} at {count}: {line['failed']}", file=sys.stderr)
            if line.get("seconds", np.inf) > options.slowest:
                peers.remove(peer)


if __name__ == "__main__":
    main()
