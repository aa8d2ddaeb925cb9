"""``python -m tests.fuzz``: spoils small scenes at random and sends them through ``warpmag check`` and ``run``.

    python -m tests.fuzz --count 3000 --seed 7              each stage in a process of its own
    python -m tests.fuzz --count 300 --seed 7 --batch 100   a hundred of them in one process
    python -m tests.fuzz --count 100 --seed 7 --fresh       each command in a fresh interpreter
    python -m tests.fuzz --count 3000 --workers 14          fourteen processes at a time
    python -m tests.fuzz --seed 7 --only 1234               one stage, which is kept in the folder
    python -m tests.fuzz --count 200 --runs                 files of interrupted runs, which go on

Stages with problems are kept in the folder, beside ``verdicts.jsonl`` with a line about each stage. ``--resume`` goes
on behind the lines that are there. Ends with 1 where there are problems. Everything runs on the CPU: a GPU does not
survive a fork, so it is hidden from the start.
"""

import argparse
import json
import os
import sys
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path

os.environ["PXR_WORK_THREAD_LIMIT"] = "1"  # USD's threads do not survive a fork
os.environ["CUDA_VISIBLE_DEVICES"] = ""  # nor does CUDA
os.environ["OPENBLAS_NUM_THREADS"] = "1"  # a worker has a share of the cores, and they would wait for each other


def main() -> int:
    """Run a campaign and return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=300, help="stages (default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first of them (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="which stages (default: %(default)s)")
    parser.add_argument("--only", type=int, metavar="N", help="number of the only stage, which is kept")
    parser.add_argument("--batch", type=int, default=1, help="stages of one process (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=1, help="processes at a time (default: %(default)s)")
    parser.add_argument("--resume", action="store_true", help="leave out the stages that have a line in the folder")
    parser.add_argument("--runs", action="store_true", help="interrupted runs in place of stages")
    parser.add_argument("--fresh", action="store_true", help="a fresh interpreter for each command")
    parser.add_argument("-o", "--output", type=Path, default=Path("fuzz_out"), help="folder (default: %(default)s)")
    options = parser.parse_args()

    from .campaign import Campaign, in_fresh_process, in_process, warm_up  # noqa: PLC0415 - imports USD, which reads the environment
    from .resumes import author_runs, judge_resume  # noqa: PLC0415
    from .sources import author, author_others  # noqa: PLC0415

    folder = options.output.absolute()
    sources = author(folder / "sources")
    campaign = Campaign(
        options.seed,
        folder,
        sources,
        batch=options.batch,
        workers=options.workers,
        fresh=options.fresh,
        keep=options.only is not None,
    )
    began = time.monotonic()
    warm_up([*sources, *author_others(folder / "others")], in_fresh_process, options.workers)
    print(f"kernels ready after {time.monotonic() - began:.0f} s", flush=True)
    if not options.fresh:
        warm_up(sources, in_process)
    if options.runs:
        campaign.sources, campaign.trial = author_runs(sources, folder / "runs"), judge_resume
    numbers = [options.only] if options.only is not None else range(options.first, options.first + options.count)
    verdicts = _earlier(folder / "verdicts.jsonl") if options.resume else []
    left = [number for number in numbers if number not in {verdict.number for verdict in verdicts}]
    with open(folder / "verdicts.jsonl", "a", encoding="utf-8") as file:
        for verdict in campaign.verdicts(left):
            print(json.dumps(asdict(verdict), ensure_ascii=False), file=file, flush=True)
            verdicts.append(verdict)
            if verdict.problems or options.only is not None:
                print(
                    f"seed {options.seed}, {verdict.number}: {verdict.done}\n    {verdict.line}",
                    *verdict.problems,
                    sep="\n    ",
                    flush=True,
                )
    _print_table(verdicts)
    return 1 if any(verdict.problems for verdict in verdicts) else 0


def _earlier(path: Path) -> list:
    """Return the verdicts in a file of an interrupted campaign; a line that was begun is dropped from the file."""
    from .campaign import Verdict  # noqa: PLC0415

    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    if lines and not lines[-1].endswith(b"\n"):
        path.write_bytes(b"".join(lines := lines[:-1]))
    return [Verdict(**json.loads(line)) for line in lines]


def _print_table(verdicts: list) -> None:
    """Print how many stages of each form ended how, and the CPU times."""
    table = Counter()
    for verdict in verdicts:
        table[verdict.form, {0: "run", 2: "refused"}.get(verdict.run, "neither")] += 1
        table[verdict.form, "problems"] += bool(verdict.problems)
    ends, forms = ("run", "refused", "neither", "problems"), [*dict.fromkeys(form for form, _ in table)]
    print(f"{'':10}", *(f"{end:>10}" for end in ends))
    for form in sorted(forms):
        print(f"{form:10}", *(f"{table[form, end]:10}" for end in ends))
    print(f"{'all':10}", *(f"{sum(table[form, end] for form in forms):10}" for end in ends))
    seconds = sorted((verdict.seconds for verdict in verdicts), reverse=True)
    longest = ", ".join(f"{longest:.0f}" for longest in seconds[:5])
    print(f"{len(seconds)} stages, {sum(seconds):.0f} s of CPU time in all, the longest {longest} s")


if __name__ == "__main__":
    sys.exit(main())
