"""The three ways in which work can end badly. The CLI turns them into one sentence and an exit code."""

from __future__ import annotations


class MasivError(Exception):
    """The work failed (exit code 1). The message says what, where and what to do."""


class InputError(MasivError):
    """What the user gave cannot be used (exit code 2). The message says what, where and what to do."""


class NonFiniteError(MasivError):
    """A simulated particle became non-finite or moved faster than the grid allows.

    Attributes: ``substep``, counted from the start of the simulation, and ``particle``, the indices where it was first
    seen; ``detail``, what was seen.
    """

    def __init__(self, substep: int, particle: int, detail: str) -> None:
        super().__init__(
            f"simulation left the valid range at substep {substep}, particle {particle}: {detail}; "
            "take shorter substeps (lower simulator.courant_number) or a softer starting law"
        )
        self.substep = substep
        self.particle = particle
        self.detail = detail

    def __reduce__(self) -> tuple[type[NonFiniteError], tuple[int, int, str]]:
        """How it is copied and pickled: an exception's own way would give ``__init__`` the message alone."""
        return type(self), (self.substep, self.particle, self.detail)
