"""The page: a server on this machine that shows a subject and simulates it again when a slider moves."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.report.viewpoints import looking_at
from masiv.simulation.rollout import Rollout
from masiv.view.controls import Controls
from masiv.view.nodes import Nodes
from masiv.view.shown import Shown
from masiv.view.simulations import Simulations
from masiv.view.subject import Subject
from masiv.view.variation import Job, Variation

PORTS = 100
"""That are tried."""
IDLE_S = 0.1
"""Between two looks at whether the motion plays."""


class Page:
    """What a viser ``server`` shows of ``subject``. shown: the motion that is on the page, None before the first."""

    def __init__(self, server: Any, subject: Subject, arch: str) -> None:
        self.server, self.subject = server, subject
        self.shown: Shown | None = None
        self._lock = threading.RLock()  # of what is drawn: widgets and simulations call from threads of their own
        job = Job(subject.twin, subject.frames, subject.other)
        self.simulations = Simulations(
            job, arch, progress=self._progress, finished=self._finished, failed=self._failed
        )  # fmt: skip
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        server.gui.set_panel_label(f"masiv: {subject.title}")
        self.nodes = Nodes(server.scene, subject)
        self.controls = Controls(server.gui, subject, self.draw, self.simulate)
        self._aimed = False
        self._look_at_body()
        self.draw()

    def _look_at_body(self) -> None:
        """Let the page open with the observed motion, or the body, before it. Points in flight that were not observed
        in space are found when they have been simulated."""
        subject = self.subject
        points = subject.observed
        if points is None:
            particles = [body.particles for body in subject.twin.bodies if body.particles is not None]
            if not particles:
                return
            points = particles[0][None]
        self._look_at(points)

    def _look_at(self, points: np.ndarray) -> None:
        """Let the page open, and let those who look turn, so that ``points`` (T, N, 3) [m] are in view."""
        low, high = np.nanmin(points, (0, 1)), np.nanmax(points, (0, 1))
        middle, radius = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 0.5 * self.nodes.size)
        up = self.subject.twin.up / np.linalg.norm(self.subject.twin.up)
        side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
        side /= np.linalg.norm(side)
        place = middle + 3.0 * radius * (0.8 * side + 0.5 * np.cross(side, up) + 0.35 * up)
        camera = looking_at(place, middle, up, (1, 1))
        initial = self.server.initial_camera
        initial.position, initial.look_at, initial.fov = tuple(camera.centre), tuple(middle), 0.9
        initial.near, initial.far = 0.01 * radius, 200 * radius
        self._aimed = True
        for client in self.server.get_clients().values():
            client.camera.position, client.camera.look_at = tuple(camera.centre), tuple(middle)
            client.camera.near, client.camera.far = initial.near, initial.far

    def draw(self) -> None:
        """Bring the scene to what the widgets say."""
        with self._lock, self.server.atomic():
            frame = int(self.controls.frame.value)
            self.controls.say_time(frame)
            self.nodes.draw(self.shown, frame, self.controls.look)

    def simulate(self) -> None:
        """Simulate what the sliders say."""
        self.controls.status.content = "simulating …"
        self.simulations.ask(self.controls.variation)

    def _progress(self, done: int, total: int) -> None:
        self.controls.say_progress(done, total)

    def _finished(self, variation: Variation, rollout: Rollout) -> None:
        with self._lock:
            self.shown = Shown(self.subject, rollout)
            if not self._aimed:
                self.nodes.size = self.shown.size
                self._look_at(rollout.positions)
            self.controls.show(self.shown)
            self.controls.say_arrows(self.shown)
        changed = "as identified" if variation == Variation() else "with the values of the sliders"
        self.controls.say(f"{rollout.positions.shape[1]} particles, {changed}")

    def _failed(self, variation: Variation, sentence: str) -> None:
        before = "" if self.shown is None else " The last motion that could be simulated is shown."
        self.controls.say(f"**This cannot be simulated:** {sentence}.{before}")

    def run(self) -> None:
        """Let the motion play, until an exception (Ctrl-C) ends it."""
        while True:
            self.step()

    def step(self) -> None:
        """One frame further, if it plays; returns when the next one is due."""
        if not self.controls.play.value:
            time.sleep(IDLE_S)
            return
        due = time.monotonic() + 1 / self.controls.rate.value
        self.controls.frame.value = (int(self.controls.frame.value) + 1) % self.subject.frames
        time.sleep(max(0.0, due - time.monotonic()))


@contextmanager
def open_page(subject: Subject, *, host: str = "127.0.0.1", port: int = 8080, arch: str = "cpu") -> Iterator[Page]:
    """The page of ``subject``, whose first simulation has begun. At the end of the block server and simulation are
    gone. If ``port`` is in use, the next one that is free is taken. Raises InputError if the package viser is missing
    or no page can be served there."""
    try:
        import viser
    except ImportError as error:
        raise InputError("masiv view needs the package viser: pip install 'masiv[view]'") from error
    free = free_port(host, port)
    with contextlib.redirect_stdout(io.StringIO()):  # it prints its address, and here the caller says it
        server = viser.ViserServer(host=host, port=free, verbose=False)
    try:
        page = Page(server, subject, arch)
        with page.simulations:
            page.simulate()
            yield page
    finally:
        with contextlib.redirect_stdout(io.StringIO()):  # it says that it has stopped
            server.stop()


def free_port(host: str, port: int) -> int:
    """``port``, or the first one after it that is not in use. Raises InputError if ``host`` is not this machine, or no
    port is free: the server itself would go on trying for ever."""
    for candidate in range(port, min(port + PORTS, 65536)):
        try:
            with socket.create_server((host, candidate), family=_family(host)):
                return candidate
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise InputError(
                    f"--host {host[:60]}: no page can be served there ({error.strerror or error})"
                ) from error
    raise InputError(f"--port {port}: it is in use or not allowed, and so are those after it; give another one")


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET
