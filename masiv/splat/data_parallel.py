"""A second process that computes the gradient of one part of each step of ``reconstruct``.

Parameters and gradients are in memory that both processes map. The description of the part, its loss and errors go
through pipes. Both processes compute a part in the same way, so a fit has the same bits with one process and with two.

It is not a process of ``multiprocessing``: the caller's script is not imported again, so it needs no main guard. It is
in a session of its own: Ctrl-C interrupts the caller only, which then kills it. It ends if the caller is killed.
"""

from __future__ import annotations

import json
import mmap
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from masiv import runtime
from masiv.errors import MasivError
from masiv.runtime import ONE_THREAD
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.image_formation import ImageFormation
from masiv.splat.losses import Pairs
from masiv.splat.objective import PARAMETER_NAMES, Objective, Part
from masiv.workers import run_task, unwrap

Gradients = Sequence[torch.Tensor | None]
EXIT_TIMEOUT_S = 10.0
_COMMAND = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from masiv.parent import end_with_parent; end_with_parent(int(sys.argv[4])); "
    "from masiv.splat.data_parallel import serve; serve(int(sys.argv[2]), int(sys.argv[3]))"
)
"""Imports from where this process does, as ``multiprocessing`` has it; PYTHONPATH stays as it is."""


@dataclass(frozen=True)
class Networks:
    """What moves the Gaussians, and what corrects cameras and exposures (None: they are as given)."""

    deformation: DeformationNetwork
    formation: ImageFormation | None = None

    def parameters(self) -> list[torch.nn.Parameter]:
        """Those of both."""
        return [*self.deformation.parameters(), *(self.formation.parameters() if self.formation is not None else ())]


def parameters(gaussians: dict[str, torch.Tensor], networks: Networks) -> list[torch.Tensor]:
    """All parameters, in the order of their gradients."""
    return [*(gaussians[name] for name in PARAMETER_NAMES), *networks.parameters()]


def gradients(
    objective: Objective,
    gaussians: dict[str, torch.Tensor],
    networks: Networks,
    pairs: Pairs,
    part: Part,
    *,
    corrected: bool,
) -> tuple[float, Gradients]:
    """The loss of ``part`` and its gradient for each of ``parameters``, None for one that it does not depend on.

    corrected: whether cameras and exposures are corrected yet.
    """
    formation = networks.formation if corrected else None
    loss = objective.part(gaussians, networks.deformation, pairs, part, formation)
    return float(loss.detach()), torch.autograd.grad(loss, parameters(gaussians, networks), allow_unused=True)


class GradientWorker:
    """The second process, as the first one sees it. Use as a context: the process starts at once and ends with it."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(dir="/dev/shm" if os.path.isdir("/dev/shm") else None)
        threads = dict.fromkeys(ONE_THREAD, str(max(1, runtime.threads() // 2)))
        numbers = (self._file.fileno(), torch.get_num_threads(), os.getpid())
        arguments = (json.dumps(sys.path), *map(str, numbers))
        self._process = subprocess.Popen(
            [sys.executable, "-c", _COMMAND, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(self._file.fileno(),),
            start_new_session=True,
            env={**os.environ, **threads},
        )
        self._pairs: Pairs | None = None

    def __enter__(self) -> GradientWorker:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None  # noqa: PT018
        if kind is not None:
            self._process.kill()
        try:
            self._process.stdin.close()
        except OSError:  # the process died
            pass
        try:
            self._process.wait(EXIT_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._file.close()

    def configure(self, objective: Objective, networks: Networks, count: int) -> None:
        """Send what is the same for all steps. count: Gaussians, at most. Raises MasivError if the process died."""
        size = 8 * count + sum(p.numel() for p in networks.parameters())
        self._file.truncate(2 * 4 * size)
        self._values, self._gradients = _mapped(self._file.fileno(), size)
        # Each part brings its images.
        self._send((replace(objective, images={}), networks, size))

    def submit(
        self, gaussians: dict[str, torch.Tensor], networks: Networks, pairs: Pairs, part: Part, *, corrected: bool
    ) -> None:
        """Start computing ``part``; ``result`` waits for it. Raises MasivError if the process died."""
        self._parameters = parameters(gaussians, networks)
        flat = torch.cat([parameter.detach().flatten() for parameter in self._parameters])
        self._values[: len(flat)] = flat
        self._send((part, len(gaussians["means"]), None if pairs is self._pairs else pairs, corrected))
        self._pairs = pairs

    def result(self) -> tuple[float, Gradients]:
        """``gradients`` of the submitted part. Raises its MasivError, and MasivError if the process died."""
        try:
            loss, known = unwrap(pickle.load(self._process.stdout))  # type: ignore[arg-type]
        except (EOFError, pickle.UnpicklingError) as died:
            raise _died() from died
        found = _views(self._gradients, [parameter.shape for parameter in self._parameters])
        return loss, [gradient if is_known else None for gradient, is_known in zip(found, known, strict=True)]

    def _send(self, message: Any) -> None:
        try:
            pickle.dump(message, self._process.stdin, pickle.HIGHEST_PROTOCOL)  # type: ignore[arg-type]
            self._process.stdin.flush()  # type: ignore[union-attr]
        except BrokenPipeError as died:
            raise _died() from died


def _died() -> MasivError:
    return MasivError(
        "the second process of reconstruct died, perhaps for lack of memory: set reconstruct.processes to 1"
    )


def _mapped(file: int, size: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The memory that both processes map: parameters and gradients (size,), float32."""
    memory = torch.frombuffer(mmap.mmap(file, 2 * 4 * size), dtype=torch.float32)
    return memory[:size], memory[size:]


def _views(flat: torch.Tensor, shapes: Sequence[torch.Size]) -> list[torch.Tensor]:
    sizes = [shape.numel() for shape in shapes]
    return [v.view(shape) for v, shape in zip(flat[: sum(sizes)].split(sizes), shapes, strict=True)]


class _Server:
    """The state of the second process."""

    def __init__(self, file: int, objective: Objective, networks: Networks, size: int) -> None:
        self.objective, self.networks = objective, networks
        self.values, self.gradients = _mapped(file, size)
        self.pairs: Pairs = ()

    def compute(self, part: Part, count: int, pairs: Pairs | None, corrected: bool) -> tuple[float, list[bool]]:
        """The loss, and which parameters it depends on. Their gradients are written to the common memory."""
        self.pairs = pairs or self.pairs
        shapes = [torch.Size(s) for s in ((count, 3), (count,), (count,), (count, 3))]
        shapes += [p.shape for p in self.networks.parameters()]
        given = _views(self.values, shapes)
        gaussians = {name: v.clone().requires_grad_() for name, v in zip(PARAMETER_NAMES, given, strict=False)}
        with torch.no_grad():
            for parameter, value in zip(self.networks.parameters(), given[len(PARAMETER_NAMES) :], strict=True):
                parameter.copy_(value)
        loss, found = gradients(self.objective, gaussians, self.networks, self.pairs, part, corrected=corrected)
        for gradient, target in zip(found, _views(self.gradients, shapes), strict=True):
            if gradient is not None:
                target.copy_(gradient)
        return loss, [gradient is not None for gradient in found]


def serve(file: int, threads: int) -> None:
    commands, answers = sys.stdin.buffer, os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints must not reach the pipe
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
