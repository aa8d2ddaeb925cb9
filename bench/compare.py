"""Compares warpmag and its peers on the same arrays: ``python -m bench.compare [--device cuda:0] [--sizes 243]``.

The timed work is the field of n dipoles at each other, with data and results on the device: evaluations in sequence
and one wait at their end. For ``h_field`` it is the whole call. Peers take turns. Each field is compared with the
float64 oracle at some targets. Each measurement is one JSON line. A peer that fails, or is not installed, gets a line
with the error.
"""

import argparse
import contextlib
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

from bench.cases import touching_pile
from bench.machine import line_writer
from bench.peers import PEERS, Peer
from bench.reference import oracle

SIZES = {"cpu": (243, 1032, 2560, 10000, 20000), "cuda": (243, 1032, 2560, 10000, 32768, 131072, 262144)}
_CHECKED = 32  # number of targets compared with the oracle
_LAPS = 7


def arrays(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions [m] and moments [A·m²] of a pile of balls, the same in every run, float32, shape [count, 3]."""
    moments = np.random.default_rng(1).normal(size=(count, 3)) * 0.3 + [0.0, 0.0, 1.0]
    return touching_pile(count), moments.astype(np.float32)


def reference(positions, moments) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the targets, and the oracle's field [A/m] at them."""
    targets = np.linspace(0, len(positions) - 1, min(_CHECKED, len(positions))).astype(int)
    x, m = positions.astype(float), moments.astype(float)
    fields = [oracle.h_field(np.delete(x, i, 0), np.delete(m, i, 0), x[i : i + 1])[0] for i in targets]
    return targets, np.array(fields)


class Measurement:
    """One peer at one size, timed lap by lap."""

    def __init__(self, peer: Peer, positions, moments, device, seconds: float):
        """Prepare the peer, run it once, and choose the evaluations per lap so that all laps take ``seconds``."""
        began = time.perf_counter()
        self._evaluation = peer.prepare(positions, moments, device)
        self._evaluations, self._times, self._pairs = 1, [], len(positions) ** 2
        self.lap()
        self._first = time.perf_counter() - began
        self.lap()
        self._evaluations = max(1, round(seconds / _LAPS / self._times[1]))
        self._times = []

    def lap(self) -> None:
        """Time one lap; two laps are enough where one evaluation is a lap."""
        if self._evaluations == 1 and len(self._times) >= 2:
            return
        start = time.perf_counter()
        for _ in range(self._evaluations):
            self._evaluation.run()
        self._evaluation.wait()
        self._times.append((time.perf_counter() - start) / self._evaluations)

    def result(self, targets, expected) -> dict:
        """Times of an evaluation, and the errors of its field at the targets."""
        best = min(self._times)
        return {
            "seconds": best,
            "median_seconds": float(np.median(self._times)),
            "pairs_per_second": self._pairs / best,
            **errors(self._evaluation.result()[targets], expected),
            "first_call_seconds": self._first,
        }


def errors(values, expected) -> dict:
    """RMS error and largest error of vectors, shape [rows, 3], over the RMS of the expected ones."""
    distance = np.linalg.norm(values - expected, axis=1)
    mean = np.sqrt((expected**2).sum() / len(expected))
    return {"error": float(np.sqrt((distance**2).mean()) / mean), "largest_error": float(distance.max() / mean)}


def compare(peers: list[Peer], positions, moments, exact, device: str, seconds: float) -> dict[str, dict]:
    """Measure peers, lap by lap in turns, so that other load of the machine affects all of them.

    ``exact`` are the indices of some targets and the exact fields at them. Returns the values of each peer's line by
    its name, or ``failed`` and the error.
    """
    running, lines = {}, {}

    def attempt(name, call, *arguments):
        try:
            with contextlib.redirect_stdout(sys.stderr):  # some libraries print
                return call(*arguments)
        except Exception as error:  # a peer's failure is a result: the others go on
            lines[name] = {"failed": f"{type(error).__name__}: {error}".splitlines()[0][:200]}

    for peer in peers:
        running[peer.name] = attempt(peer.name, Measurement, peer, positions, moments, device, seconds)
    for _ in range(_LAPS):
        for name in [name for name in running if name not in lines]:
            attempt(name, running[name].lap)
    for name in [name for name in running if name not in lines]:
        result = attempt(name, running[name].result, *exact)
        lines[name] = result or lines[name]
    return {name: lines[name] for name in running}


def main(arguments=None) -> None:
    """Run the comparison that the command line describes."""
    choices = {peer.name: peer for peer in PEERS if not peer.charges}
    parser = argparse.ArgumentParser(
        prog="python -m bench.compare",
        description=__doc__.partition("\n")[0],
        epilog="peers: " + "; ".join(f"{name} ({peer.summary})" for name, peer in choices.items()),
    )
    add = parser.add_argument
    add("--device", default="cpu")
    add("--sizes", type=int, nargs="+", help="numbers of dipoles; default by device")
    add("--peers", nargs="+", choices=choices, default=choices, help="default: all")
    add("--seconds", type=float, default=0.3, help="time for each measurement (default 0.3)")
    add("--slowest", type=float, default=0.1, help="seconds beyond which larger sizes are skipped (0.1)")
    add("-o", "--output", type=Path, help="file that the lines are appended to")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(options.device)
    kind, write = "cpu" if device.is_cpu else "cuda", line_writer(device, options.output)
    peers = [choices[name] for name in options.peers if kind in choices[name].devices]
    for count in options.sizes or SIZES[kind]:
        positions, moments = arrays(count)
        lines = compare(peers, positions, moments, reference(positions, moments), str(device), options.seconds)
        for name, line in lines.items():
            write({"case": "compare", "peer": name, "count": count} | line)
            if "failed" in line:
                print(f"{name} at {count}: {line['failed']}", file=sys.stderr)
        peers = [peer for peer in peers if lines[peer.name].get("seconds", np.inf) <= options.slowest]


if __name__ == "__main__":
    main()
