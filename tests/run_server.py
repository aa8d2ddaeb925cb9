"""Runs the command in child processes that are made ready beforehand, so that a test can end one at any moment.

As a program it reads lines of JSON from its standard input: the arguments of a command, a file for its messages and one
for the times of its frames. The first command it runs itself, which loads everything that a run needs. For each of the
others it forks a process that runs it, and answers with its number and, once that has ended, with how it ended, as
``subprocess`` counts it. A GPU does not survive a fork, so it is hidden from all of them.
"""

import json
import os
import subprocess
import sys
import time


def _serve() -> None:
    from warpmag import cli  # noqa: PLC0415 - only the server itself needs it

    answers = os.fdopen(os.dup(1), "w")
    for number, line in enumerate(sys.stdin):
        command = json.loads(line)
        child = os.fork() if number else os.getpid()
        if not child:
            os._exit(_run(cli, **command))
        print(child, file=answers, flush=True)
        if number:
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        else:
            code = _run(cli, **command)
        print(code, file=answers, flush=True)


def _run(cli, arguments: list[str], messages: str, frames: str) -> int:
    os.dup2(os.open(messages, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
    os.dup2(2, 1)
    log = os.open(frames, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    cli.Progress._draw = lambda self, frame: os.write(log, f"{time.monotonic()} {frame}\n".encode())
    code = cli.main(arguments)
    sys.stdout.flush()
    return code


class RunServer:
    """A server of runs, and the run that it has started last."""

    def __init__(self):
        """Start the server."""
        command = [sys.executable, __file__]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )

    def _answer(self) -> str:
        return self._process.stdout.readline().strip()

    def start(self, arguments, messages, frames) -> int:
        """Start a run; return the number of its process."""
        command = {"arguments": list(map(str, arguments)), "messages": str(messages), "frames": str(frames)}
        print(json.dumps(command), file=self._process.stdin, flush=True)
        return int(self._answer())

    def wait(self) -> int:
        """Wait for its end and return its exit code, negative for a signal."""
        return int(self._answer())

    def close(self) -> None:
        """End the server."""
        self._process.stdin.close()
        self._process.wait()


if __name__ == "__main__":
    os.environ["CUDA_VISIBLE_DEVICES"] = ""
    _serve()
