"""The three ways in which work can end badly. The CLI turns them into one sentence and an exit code."""

from __future__ import annotations


class MasivError(Exception):
    """The work failed (exit code 1). The message says what, where and what to do."""


class InputError(MasivError):
    """What the user gave cannot be used (exit code 2). The message says what, where and what to do."""


class NonFiniteError(MasivError):
    """A simulated particle became non-finite or moved faster than the grid allows.

    Attributes: ``substep`` and ``particle`` are the indices where it was first seen.
    """

    def __init__(self, substep: int, particle: int, detail: str) -> None:
        super().__init__(
            f"simulation left the valid range at substep {substep}, particle {particle}: {detail}; "
            "use more substeps (simulator.substep_safety) or a softer starting law"
        )
        self.substep = substep
        self.particle = particle
