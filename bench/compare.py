"""warpmag and its peers, in one run on the same arrays: ``python -m bench.compare [--device cuda:0] [--sizes 243]``.

What is timed is the field of n dipoles at each other, data in place, results left in place: evaluations one after the
other and one wait at their end; of ``h_field`` the whole call. Peers take turns. Each field is
compared with the float64 oracle on some targets. One JSON line a measurement; a peer whose library is missing, or that
fails at a size, gets a line that says so.
"""

import argparse
import contextlib
import importlib
import json
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

from bench.cases import touching_pile
from bench.machine import describe
from bench.peers import PEERS, Peer
from bench.reference import oracle

SIZES = {"cpu": (243, 1032, 2560, 10000, 20000), "cuda": (243, 1032, 2560, 10000, 32768, 131072, 262144)}
_CHECKED = 32
"""Targets compared with the oracle."""
_LAPS = 7


def arrays(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions [m] and moments [A·m²] of a pile of balls, alike in every run, float32, shape [count, 3]."""
    moments = np.random.default_rng(1).normal(size=(count, 3)) * 0.3 + [0.0, 0.0, 1.0]
    return touching_pile(count), moments.astype(np.float32)


def reference(positions, moments) -> tuple[np.ndarray, np.ndarray]:
    """Some targets, and the oracle's field [A/m] at them."""
    targets = np.linspace(0, len(positions) - 1, min(_CHECKED, len(positions))).astype(int)
    x, m = positions.astype(float), moments.astype(float)
    others = [np.arange(len(x)) != i for i in targets]
    return targets, np.array(
        [oracle.h_field(x[o], m[o], x[i : i + 1])[0] for i, o in zip(targets, others, strict=True)]
    )


class Measurement:
    """One peer at one size: made ready, and timed lap by lap."""

    def __init__(self, peer: Peer, positions, moments, device, seconds: float):
        """Prepare and run it once, and find how many evaluations make a lap, of ``seconds`` in all."""
        began = time.perf_counter()
        self._evaluation = importlib.import_module(f"bench.peers.{peer.name}").prepare(positions, moments, device)
        self._evaluations, self._times, self._pairs = 1, [], len(positions) ** 2
        self.lap()
        self._first = time.perf_counter() - began
        self.lap()
        self._evaluations = max(1, round(seconds / _LAPS / self._times[1]))
        self._times = []

    def lap(self) -> None:
        """Time one lap, unless evaluations are so long that two are enough."""
        if self._evaluations == 1 and len(self._times) >= 2:
            return
        start = time.perf_counter()
        for _ in range(self._evaluations):
            self._evaluation.run()
        self._evaluation.wait()
        self._times.append((time.perf_counter() - start) / self._evaluations)

    def result(self, expected) -> dict:
        """Times of an evaluation, and the error of what it leaves."""
        targets, fields = expected
        best = min(self._times)
        return {
            "seconds": best,
            "median_seconds": float(np.median(self._times)),
            "pairs_per_second": self._pairs / best,
            "error": float(np.linalg.norm(self._evaluation.result()[targets] - fields) / np.linalg.norm(fields)),
            "first_call_seconds": self._first,
        }


def compare(peers: dict[str, Peer], count: int, device: str, seconds: float) -> dict[str, dict]:
    """Measure peers at one size, lap by lap in turns: what else the machine does slows all of them down.

    Returns:
        What there is to say of each, by name.
    """
    positions, moments = arrays(count)
    expected = reference(positions, moments)
    running, lines = {}, {}

    def attempt(name, call, *arguments):
        try:
            with contextlib.redirect_stdout(sys.stderr):  # some libraries talk
                return call(*arguments)
        except Exception as problem:  # a peer's failure is a result: the others go on
            lines[name] = {"failed": f"{type(problem).__name__}: {problem}".splitlines()[0][:200]}

    for name, peer in peers.items():
        running[name] = attempt(name, Measurement, peer, positions, moments, device, seconds)
    for _ in range(_LAPS):
        for name in [name for name in peers if name not in lines]:
            attempt(name, running[name].lap)
    for name in [name for name in peers if name not in lines]:
        result = attempt(name, running[name].result, expected)
        lines[name] = result or lines[name]
    return {name: lines[name] for name in peers}


def run(device, sizes, names, seconds: float, slowest: float, emit) -> None:
    """Measure every peer at every size.

    Args:
        device: Warp device.
        sizes: Numbers of dipoles.
        names: Peers to run; None means all.
        seconds: Time to spend on laps [s].
        slowest: A peer that once took longer than this for an evaluation [s] is not run at larger sizes.
        emit: Takes each result, a dict.
    """
    machine = describe(device)
    kind = "cpu" if device.is_cpu else "cuda"
    peers = {p.name.removeprefix("with_"): p for p in PEERS if kind in p.devices and not p.charges}
    peers = {name: peer for name, peer in peers.items() if not names or name in names}
    for count in sizes:
        lines = compare(peers, count, str(device), seconds)
        for name, line in lines.items():
            emit({"case": "compare", "peer": name, "count": count} | line | machine)
        peers = {name: peer for name, peer in peers.items() if lines[name].get("seconds", np.inf) <= slowest}


def main(arguments=None) -> None:
    """Run the comparison that the command line asks for."""
    summaries = {p.name.removeprefix("with_"): p.summary for p in PEERS if not p.charges}
    parser = argparse.ArgumentParser(
        prog="python -m bench.compare",
        description=__doc__.partition("\n")[0],
        epilog="peers: " + "; ".join(f"{name} ({summary})" for name, summary in summaries.items()),
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--sizes", type=int, nargs="+", help="numbers of dipoles; default by device")
    parser.add_argument("--peers", nargs="+", choices=summaries, help="default: all")
    parser.add_argument("--seconds", type=float, default=0.3, help="time for each measurement (default 0.3)")
    parser.add_argument(
        "--slowest",
        type=float,
        default=0.1,
        help="seconds for an evaluation beyond which a peer gets no larger sizes (0.1)",
    )
    parser.add_argument("-o", "--output", type=Path, help="file that the lines are added to, besides being printed")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(options.device)

    def emit(line):
        text = json.dumps(line)
        print(text, flush=True)
        if "failed" in line:
            print(f"{line['peer']} at {line['count']}: {line['failed']}", file=sys.stderr)
        if options.output:
            options.output.parent.mkdir(parents=True, exist_ok=True)
            with options.output.open("a") as file:
                file.write(text + "\n")

    sizes = options.sizes or SIZES["cpu" if device.is_cpu else "cuda"]
    run(device, sizes, options.peers, options.seconds, options.slowest, emit)


if __name__ == "__main__":
    main()
