"""A second process that takes a part of each step of ``reconstruct``.

Parameters go out and gradients come back in memory that both processes map; what the part is, and its loss, go through
pipes. Both processes compute a part in the same way, so a fit is the same to the bit with and without the second.
"""

from __future__ import annotations

import mmap
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from typing import Any

import torch

from masiv import runtime
from masiv.errors import MasivError
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.losses import Pairs
from masiv.splat.objective import NAMES, Objective, Part
from masiv.workers import ONE_THREAD, run_task, unwrap

Slopes = Sequence[torch.Tensor | None]
CLOSING_S = 10.0


def leaves(gaussians: dict[str, torch.Tensor], network: DeformationNetwork) -> list[torch.Tensor]:
    """All parameters, in the order of their gradients."""
    return [*(gaussians[name] for name in NAMES), *network.parameters()]


def slopes(
    objective: Objective, gaussians: dict[str, torch.Tensor], network: DeformationNetwork, pairs: Pairs, part: Part
) -> tuple[float, Slopes]:
    """The loss of ``part`` and its gradient for each of ``leaves``, None where it does not depend on one."""
    loss = objective.part(gaussians, network, pairs, part)
    return float(loss.detach()), torch.autograd.grad(loss, leaves(gaussians, network), allow_unused=True)


class Second:
    """The other process, from this one. Use as a context: it starts at once and ends with it.

    It is no child of ``multiprocessing``, so it does not import the caller's script again; and it is in a session of
    its own, so that Ctrl-C ends this process alone, which then closes the pipe that the other one listens to.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(dir="/dev/shm" if os.path.isdir("/dev/shm") else None)
        paths = os.pathsep.join(path for path in sys.path if path)
        threads = dict.fromkeys(ONE_THREAD, str(max(1, runtime.threads() // 2)))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "masiv.splat.share", str(self._file.fileno()), str(torch.get_num_threads())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(self._file.fileno(),),
            start_new_session=True,
            env={**os.environ, **threads, "PYTHONPATH": paths},
        )
        self._pairs: Pairs | None = None

    def __enter__(self) -> Second:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None  # noqa: PT018
        try:
            self._process.stdin.close()
        except OSError:  # it died
            pass
        try:
            self._process.wait(CLOSING_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._file.close()

    def give(self, objective: Objective, network: DeformationNetwork, count: int) -> None:
        """What stays the same; count: Gaussians, at most."""
        size = 8 * count + sum(p.numel() for p in network.parameters())
        self._file.truncate(2 * 4 * size)
        self._parameters, self._slopes = _mapped(self._file.fileno(), size)
        self._send((objective, network, size))

    def begin(self, gaussians: dict[str, torch.Tensor], network: DeformationNetwork, pairs: Pairs, part: Part) -> None:
        """Let it compute ``part``. Raises MasivError where it has died."""
        self._leaves = leaves(gaussians, network)
        flat = torch.cat([leaf.detach().flatten() for leaf in self._leaves])
        self._parameters[: len(flat)] = flat
        self._send((part, len(gaussians["means"]), None if pairs is self._pairs else pairs))
        self._pairs = pairs

    def end(self) -> tuple[float, Slopes]:
        """What ``slopes`` gives for the part that was begun. Raises MasivError, also where the process has died."""
        try:
            loss, known = unwrap(pickle.load(self._process.stdout))  # type: ignore[arg-type]
        except (EOFError, pickle.UnpicklingError) as died:
            raise _died() from died
        found = _views(self._slopes, [leaf.shape for leaf in self._leaves])
        return loss, [slope if is_known else None for slope, is_known in zip(found, known, strict=True)]

    def _send(self, message: Any) -> None:
        try:
            pickle.dump(message, self._process.stdin, pickle.HIGHEST_PROTOCOL)  # type: ignore[arg-type]
            self._process.stdin.flush()  # type: ignore[union-attr]
        except BrokenPipeError as died:
            raise _died() from died


def _died() -> MasivError:
    return MasivError(
        "the second process of reconstruct died, of too little memory perhaps: set reconstruct.processes to 1"
    )


def _mapped(file: int, size: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The memory of both processes: parameters and gradients (size,)."""
    memory = torch.frombuffer(mmap.mmap(file, 2 * 4 * size), dtype=torch.float32)
    return memory[:size], memory[size:]


def _views(flat: torch.Tensor, shapes: Sequence[torch.Size]) -> list[torch.Tensor]:
    sizes = [shape.numel() for shape in shapes]
    return [v.view(shape) for v, shape in zip(flat[: sum(sizes)].split(sizes), shapes, strict=True)]


class _Server:
    """What the other process does."""

    def __init__(self, file: int, objective: Objective, network: DeformationNetwork, size: int) -> None:
        self.objective, self.network = objective, network
        self.parameters, self.slopes = _mapped(file, size)
        self.pairs: Pairs = ()

    def compute(self, part: Part, count: int, pairs: Pairs | None) -> tuple[float, list[bool]]:
        """The loss, and which parameters it depends on; their gradients are written to the common memory."""
        self.pairs = pairs or self.pairs
        shapes = [torch.Size(s) for s in ((count, 3), (count,), (count,), (count, 3))]
        shapes += [p.shape for p in self.network.parameters()]
        given = _views(self.parameters, shapes)
        gaussians = {name: v.clone().requires_grad_() for name, v in zip(NAMES, given, strict=False)}
        with torch.no_grad():
            for parameter, value in zip(self.network.parameters(), given[len(NAMES) :], strict=True):
                parameter.copy_(value)
        loss, found = slopes(self.objective, gaussians, self.network, self.pairs, part)
        for slope, place in zip(found, _views(self.slopes, shapes), strict=True):
            if slope is not None:
                place.copy_(slope)
        return loss, [slope is not None for slope in found]


def _serve(file: int, threads: int) -> None:
    commands, answers = sys.stdin.buffer, os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what is printed is no answer
    torch.set_num_threads(threads)
    runtime.start("cpu")
    server: _Server | None = None
    while True:
        try:
            message = pickle.load(commands)
        except EOFError:
            return
        if server is None:
            server = _Server(file, *message)
            continue
        pickle.dump(run_task(server.compute, message), answers)
        answers.flush()


if __name__ == "__main__":
    _serve(int(sys.argv[1]), int(sys.argv[2]))
