"""The three ways in which work can end badly. The CLI turns them into one sentence and an exit code."""

from __future__ import annotations

import errno


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


_GIVEN = {
    errno.ENOENT: "give a path that can exist",
    errno.ENOTDIR: "a file stands where a folder must be: give another path",
    errno.EISDIR: "it is a folder: give the path of a file",
    errno.EEXIST: "give another path",
    errno.ENOTEMPTY: "it holds something already: give another path",
    errno.ENAMETOOLONG: "give a shorter name",
    errno.EROFS: "the disk is read-only: give a path on another one",
    errno.EACCES: "you may not do that there: give another path, or change its permissions",
    errno.EPERM: "you may not do that there: give another path, or change its permissions",
    errno.ELOOP: "its links go in a circle: give another path",
    errno.EINVAL: "give a path that can exist",
}
_FAILED = {
    errno.ENOSPC: "make room on the disk; the same command goes on from the last checkpoint",
    errno.EDQUOT: "make room in your quota; the same command goes on from the last checkpoint",
    errno.EFBIG: "the file is larger than the system allows here: give a path on another disk",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
}
_LONGEST_NAME = 200
"""Characters of a path in a message."""


def of_system(error: OSError | MemoryError) -> MasivError:
    """An error of the operating system as one sentence: InputError if a path that was given causes it."""
    if isinstance(error, MemoryError):
        return MasivError(f"out of memory ({str(error) or 'no detail'}): use fewer particles, frames or pixels")
    where = "" if error.filename is None else f"{str(error.filename)[:_LONGEST_NAME]}: "
    what = error.strerror or " ".join(str(error).split()) or type(error).__name__
    if error.errno in _GIVEN:
        return InputError(f"{where}{what}: {_GIVEN[error.errno]}")
    advice = _FAILED.get(error.errno or 0, "look after the disk and the system, and run the same command again")
    return MasivError(f"{where}{what}: {advice}")
