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
RTOLS = (None, 1e-3, 1e-5)
"""Requested relative errors; None means all pairs."""
_SPACING = 0.005
"""Lattice spacing [m]."""
_CHECKED = 100
"""Number of moments at which errors are measured."""


class Moments:
    """Moments on a device, and the arrays of their sums.

    Args:
        places: Positions [m], shape [n, 3].
        moments: Moments [A·m²], shape [n, 3].
        dtype: Warp scalar type.
        device: Warp device.
    """

    def __init__(self, places, moments, dtype, device):
        """Copy the arrays to the device."""
        n, vec3 = len(places), wp.types.vector(3, dtype)
        x, m = (wp.array(values, dtype=vec3, device=device) for values in (places, moments))
        self.packed = PackedMoments(wp.zeros(n, dtype=dtype, device=device), largest_radius=0.0, moving=False)
        self.packed.pack(x, m)
        self._base, self.out, self._torques = (wp.zeros_like(x) for _ in range(3))
        self._turned = wp.ones(n, dtype=int, device=device)

    def evaluation(self, quantity: Quantity, rows=None, sums=None) -> PairEvaluation:
        """Evaluation of a quantity into ``out``: at some rows only, or by ``sums`` in place of all pairs."""
        n = self.packed.count
        segments = [(0, n, 0, n)] if rows is None else [(row, row + 1, 0, n) for row in rows]
        return PairEvaluation(
            quantity, segments, self.packed, self.packed, self._base, self.out, with_torque=self._turned,
            torques=self._torques, sums=sums, ranks=current_ranks(),
        )  # fmt: skip

    def parts(self, quantity: Quantity, rtol: float | None) -> tuple[Callable[[], None], Callable[[], None]]:
        """Functions that build the cells of moments that have moved, and that evaluate a quantity into ``out``.

        If ``rtol`` is None there are no cells, and the evaluation sums over all pairs.
        """
        if rtol is None:
            return (lambda: None), self.evaluation(quantity).launch
        fast = FastSums(self.packed, rtol)
        return fast.build, self.evaluation(quantity, sums=fast.sums(quantity)).launch

    def work(self, quantity: Quantity, rtol: float | None) -> Callable[[], None]:
        """Function that does both parts."""
        build, evaluate = self.parts(quantity, rtol)

        def build_and_evaluate():
            build()
            evaluate()

        return build_and_evaluate


def repetitions(count: int) -> dict:
    """Arguments of ``measure`` for a number of moments: few repetitions where the launch of a graph is negligible."""
    return {"repeats": 2, "chained": 1} if count > 200_000 else {}


def lattice(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions [m] and moments [A·m²] of the first ``count`` sites, the same in every run, float32, shape [n, 3]."""
    random, side = np.random.default_rng(1), int(np.ceil(count ** (1 / 3) - 1e-9))
    sites = np.stack(np.meshgrid(*3 * [np.arange(side)], indexing="ij"), axis=-1).reshape(-1, 3)[:count]
    places = _SPACING * (sites + random.uniform(-0.15, 0.15, sites.shape))
    return places.astype(np.float32), random.normal(size=sites.shape).astype(np.float32)


def errors(values, expected) -> dict:
    """RMS error and largest error of vectors, shape [rows, 3], over the RMS of the expected ones."""
    distance = np.linalg.norm(values - expected, axis=1)
    mean = np.sqrt((expected**2).sum() / len(expected))
    return {"error": float(np.sqrt((distance**2).mean()) / mean), "largest_error": float(distance.max() / mean)}


def run_size(count: int, device, slowest: float, seconds: dict):
    """Yield the values of each quantity and method at one size.

    Args:
        count: Number of moments.
        device: Warp device.
        slowest: Expected time [s] beyond which sums over all pairs are skipped.
        seconds: Times of all pairs by quantity and count; measured times are added.
    """
    places, moments = lattice(count)
    rows = np.sort(np.random.default_rng(2).choice(count, min(_CHECKED, count), replace=False))
    exact = Moments(places.astype(float), moments.astype(float), wp.float64, device)
    own = Moments(places, moments, wp.float32, device)
    for quantity in (Quantity.FIELD, Quantity.WRENCH):
        exact.evaluation(quantity, rows).launch()
        expected = exact.out.numpy()[rows]
        for rtol in RTOLS:
            began = time.perf_counter()
            expected_seconds = min(
                (t * (count / n) ** 2 for (q, n), t in seconds.items() if q == quantity), default=0.0
            )
            if rtol is None and expected_seconds > slowest:
                continue
            work = own.work(quantity, rtol)
            work()
            wp.synchronize_device(device)
            first = time.perf_counter() - began
            taken = measure(work, device, **repetitions(count))
            if rtol is None:
                seconds[quantity, count] = taken
            line = {"quantity": quantity.name.lower(), "method": "direct" if rtol is None else "fmm", "rtol": rtol}
            line |= {"count": count, "seconds": taken, **errors(own.out.numpy()[rows], expected)}
            yield line | {"first_call_seconds": first}


def run_peer(peer: Peer, count: int, device) -> dict:
    """The values of a peer at one size; ``failed`` if the peer fails or its library is missing."""
    line = {"quantity": "field", "method": peer.name, "rtol": None, "count": count}
    places, moments = lattice(count)
    strengths = np.ascontiguousarray(moments[:, 0]) if peer.charges else moments
    rows = np.sort(np.random.default_rng(2).choice(count, min(_CHECKED, count), replace=False))
    try:
        began = time.perf_counter()
        evaluation = peer.prepare(places, strengths, str(device))
        evaluation.run()
        evaluation.wait()
        first, times = time.perf_counter() - began, []
        while not times or (sum(times) < 1.0 and len(times) < 20):
            began = time.perf_counter()
            evaluation.run()
            evaluation.wait()
            times.append(time.perf_counter() - began)
        fields = evaluation.result()[rows]
    except Exception as error:  # a peer's failure is a result: the others go on
        return line | {"failed": f"{type(error).__name__}: {error}".splitlines()[0][:200]}
    if peer.charges:
        expected = field_of_charges(places, strengths, rows)
    else:
        exact = Moments(places.astype(float), moments.astype(float), wp.float64, device)
        exact.evaluation(Quantity.FIELD, rows).launch()
        expected = exact.out.numpy()[rows]
    return line | {"seconds": float(np.median(times)), **errors(fields, expected), "first_call_seconds": first}


def field_of_charges(places, charges, rows) -> np.ndarray:
    """Field Σ q r / 4π|r|³ at some of the charges, shape [rows, 3]."""
    x, q, fields = places.astype(float), charges.astype(float), []
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

    figure, (times, accuracy) = plt.subplots(1, 2, figsize=(9.6, 4.2), layout="constrained")
    series: dict[tuple, list] = {}
    for line in sorted((line for line in lines if "seconds" in line), key=lambda line: line["count"]):
        series.setdefault((line["method"], line["rtol"], line["quantity"]), []).append(line)
    methods = sorted({key[:2] for key in series}, key=lambda m: (m[0] not in ("direct", "fmm"), m[0], -(m[1] or 1.0)))
    colors = dict(zip(methods, plt.rcParams["axes.prop_cycle"].by_key()["color"], strict=False))
    words = {"direct": "all pairs", "fmm": "multipoles"}
    for (method, rtol, quantity), points in series.items():
        style = {"color": colors[method, rtol], "linestyle": "-" if quantity == "field" else "--", "marker": "."}
        label = f"{words.get(method, method)}{f', rtol {rtol:g}' if rtol else ''}"
        counts = [line["count"] for line in points]
        named = f"{label}: {'field' if quantity == 'field' else 'force, torque'}"
        times.plot(counts, [1e3 * line["seconds"] for line in points], label=named, **style)
        accuracy.plot(counts, [line["error"] for line in points], **style)
    times.set(xscale="log", yscale="log", xlabel="moments", ylabel="time [ms]")
    accuracy.set(xscale="log", yscale="log", xlabel="moments", ylabel="relative error")
    times.legend(fontsize="x-small")
    for axis in (times, accuracy):
        axis.grid(True, alpha=0.3)
    figure.suptitle(f"{machine_of(lines[0])}, commit {lines[0]['commit']}")
    figure.savefig(path, dpi=90, pil_kwargs={"optimize": True})
    plt.close(figure)


def main(arguments=None) -> None:
    """Measure, or draw measured lines."""
    fast = {peer.name: peer for peer in PEERS if peer.charges or peer.name == "fmm3d"}
    parser = argparse.ArgumentParser(prog="python -m bench.many", description=__doc__.partition("\n")[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--sizes", type=int, nargs="+", help="numbers of moments; default by device")
    parser.add_argument("--peers", nargs="*", choices=fast, default=(), help="besides warpmag; default: none")
    parser.add_argument(
        "--slowest", type=float, default=2.0, help="seconds beyond which all pairs and peers get no larger sizes (2)"
    )
    parser.add_argument("--draw", type=Path, nargs="+", help="draw these files instead of measuring")
    parser.add_argument("-o", "--output", type=Path, help="file that lines are appended to, or the picture")
    options = parser.parse_args(arguments)
    if options.draw:
        kept = {
            (line["method"], line["rtol"], line["quantity"], line["count"]): line for line in read(options.draw)
        }  # the last line of each
        draw(list(kept.values()), options.output or Path("bench_out/many.png"))
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
