"""Which states and grids of a rollout are kept for its adjoint, and where."""

from __future__ import annotations

from dataclasses import dataclass

from masiv.mpm.state import State
from masiv.mpm.window import WINDOW_EVERY, Window


@dataclass(frozen=True)
class Segment:
    """Substeps start … start + length - 1 of a rollout; initial: the state before them."""

    start: int
    length: int
    initial: State


class Tape:
    """The memory of a rollout: the initial state of each segment, a window for each block of ``WINDOW_EVERY`` substeps.

    The states of one segment at a time are in the fields, at its local substeps 0 … length. The grids of its first
    substeps are in the log, as many as it has room for; the adjoint computes the others again from the states.
    """

    def __init__(self, scratch: int, capacity_log: int) -> None:
        """scratch: entries at the beginning of the log that keep nothing; capacity_log: its entries [nodes]."""
        self.segments: list[Segment] = []
        self.capacity_log = capacity_log
        self._windows: dict[int, Window] = {}  # of the block that begins at that substep of the rollout
        self._first_entries = {0: scratch}  # in the log, of the block that begins at that local substep

    def window(self, step: int) -> Window | None:
        """That of the block with ``step`` of the rollout; None if the block has not been simulated yet."""
        return self._windows.get(step - step % WINDOW_EVERY)

    def add_block(self, segment: Segment, begin: int, end: int, window: Window) -> None:
        """Keep that local substeps begin … end - 1 of ``segment`` have ``window``."""
        self._windows[segment.start + begin] = window
        self._first_entries[end] = self._first_entries[begin] + (end - begin) * window.nodes

    def log_entry(self, s: int, nodes: int) -> int:
        """The first entry of the grid of local substep s in the log, whether there is room for it or not."""
        begin = s - s % WINDOW_EVERY
        return self._first_entries[begin] + (s - begin) * nodes

    def log_offset(self, s: int, nodes: int) -> int:
        """Where the grid of local substep s is kept; 0 (scratch) if the log is full."""
        entry = self.log_entry(s, nodes)
        return entry if entry + nodes <= self.capacity_log else 0
