"""The 3D scene of the page: a motion and its surroundings as nodes of viser."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from masiv.scene.camera import Camera
from masiv.view.shown import OBSERVED, SIMULATED, Shown, extent, segments
from masiv.view.subject import Subject

MAX_PICTURE = 320
"""Longest side [px] of the pictures of cameras: one of each is sent for every frame."""
FRUSTUM = 0.4
"""Size of a camera over that of the body."""
LINE = 0.004
"""Thickness of a path over the size of the body."""
ARROW_COLOURS = ((200, 40, 60), (150, 50, 180), (20, 140, 90), (120, 90, 20))


@dataclass(frozen=True)
class Look:
    """How a motion is drawn. visible: names of the layers that are; field, top: colours of particles."""

    visible: frozenset[str]
    field: str
    top: float


class Nodes:
    """Draws a ``Shown`` at a frame into the ``scene`` of a viser server. Layers: gaussians, simulated, observed, paths,
    observed paths, cameras, and ``effect NAME``."""

    def __init__(self, scene: Any, subject: Subject) -> None:
        self.scene, self.subject = scene, subject
        self.handles: dict[str, Any] = {}
        self.frustums: list[tuple[int, Any]] = []
        self._pictures: dict[tuple[int, int], np.ndarray | None] = {}
        self._paths_of: Shown | None = None
        self.size = self._size()
        scene.set_up_direction(subject.twin.up)
        self._ground()
        for view, camera in enumerate(subject.cameras):
            self.frustums.append((view, self._frustum(view, camera)))
        if subject.observed is not None:
            self._points("observed", subject.observed[0], np.array(OBSERVED), 0.8 * self._spacing(subject.observed))
            self._lines("observed paths", segments(subject.observed), OBSERVED)

    def _size(self) -> float:
        if self.subject.observed is not None and not self.subject.twin.rigid:
            return extent(self.subject.observed[:1])
        particles = [body.particles for body in self.subject.twin.bodies if body.particles is not None]
        return extent(particles[0][None]) if particles else 1.0

    def _spacing(self, observed: np.ndarray) -> float:
        """Distance [m] of observed particles; of markers, a twentieth of the body."""
        particles = self.subject.twin.bodies[0].particles
        if particles is not None and len(particles) == observed.shape[1]:
            return (self.subject.twin.bodies[0].volume / len(particles)) ** (1 / 3)
        return 0.05 * self.size

    def draw(self, shown: Shown | None, frame: int, look: Look) -> None:
        """Bring the page to ``frame`` of ``shown`` (None: nothing has been simulated yet)."""
        observed = self.subject.observed
        if observed is not None:
            there = frame < len(observed)
            if there:
                self.handles["observed"].points = _finite(observed[frame])
            self.handles["observed"].visible = there and ("observed" in look.visible or shown is None)
            self.handles["observed paths"].visible = "observed paths" in look.visible
        for view, frustum in self.frustums:
            frustum.visible = "cameras" in look.visible
            if frustum.visible:
                frustum.image = self._picture(view, frame)
        if shown is not None:
            self._draw_motion(shown, frame, look)

    def _draw_motion(self, shown: Shown, frame: int, look: Look) -> None:
        if self._paths_of is not shown:
            self._lines("paths", shown.paths, SIMULATED)
            self._paths_of = shown
        self.handles["paths"].visible = "paths" in look.visible
        colours = shown.colours(look.field, frame, look.top)
        self._points("simulated", shown.positions[frame], colours, 0.9 * shown.particle_spacing)
        self.handles["simulated"].visible = "simulated" in look.visible
        if "gaussians" in look.visible:
            self._splats(shown, frame)
        elif "gaussians" in self.handles:
            self.handles["gaussians"].visible = False
        for k, name in enumerate(shown.accelerations):
            self._arrows(f"effect {name}", shown.arrows(name, frame), ARROW_COLOURS[k % 4], shown.size, look)

    def _points(self, name: str, points: np.ndarray, colours: np.ndarray, size: float) -> None:
        points, colours = _finite(points), colours.astype(np.uint8)
        handle = self.handles.get(name)
        if handle is None or len(handle.points) != len(points):
            self.handles[name] = self.scene.add_point_cloud(
                f"/{name}", points, colours, point_size=size, point_shape="circle", precision="float32"
            )
            return
        handle.points, handle.colors = points, colours

    def _lines(self, name: str, lines: np.ndarray, colour: tuple[int, int, int]) -> None:
        self.handles[name] = self.scene.add_line_segments(f"/{name}", lines, colour, thickness=LINE * self.size)

    def _splats(self, shown: Shown, frame: int) -> None:
        gaussians = shown.gaussians(frame)
        if gaussians is None:
            return
        variances = gaussians.scales.numpy().astype(np.float64) ** 2
        self.handles["gaussians"] = self.scene.add_gaussian_splats(
            "/gaussians",
            gaussians.means.numpy(),
            variances[:, None, None] * np.eye(3),
            np.clip(gaussians.colours.numpy(), 0, 1),
            gaussians.opacities.numpy()[:, None],
        )

    def _arrows(self, name: str, arrows: np.ndarray, colour: tuple[int, int, int], size: float, look: Look) -> None:
        visible = name in look.visible and len(arrows) > 0
        if visible:
            self.handles[name] = self.scene.add_arrows(
                f"/{name}", arrows.astype(np.float32), colour,
                shaft_radius=0.006 * size, head_radius=0.016 * size, head_length=0.035 * size,
            )  # fmt: skip
        elif name in self.handles:
            self.handles[name].visible = False

    def _frustum(self, view: int, camera: Camera) -> Any:
        from viser.transforms import SO3

        return self.scene.add_camera_frustum(
            f"/cameras/{view}",
            fov=2 * math.atan(0.5 * camera.height / camera.intrinsics[1, 1]),
            aspect=camera.width / camera.height,
            scale=FRUSTUM * self.size,
            thickness=LINE * self.size,
            wxyz=SO3.from_matrix(camera.world_to_camera[:3, :3].T).wxyz,
            position=camera.centre,
            visible=False,
        )

    def _picture(self, view: int, frame: int) -> np.ndarray | None:
        if (view, frame) not in self._pictures:
            picture = self.subject.picture(view, frame)
            if picture is not None and max(picture.shape[:2]) > MAX_PICTURE:
                factor = MAX_PICTURE / max(picture.shape[:2])
                picture = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
            self._pictures[view, frame] = picture
        return self._pictures[view, frame]

    def _ground(self) -> None:
        from viser.transforms import SO3

        ground = self.subject.twin.ground
        if ground is None:
            return
        normal = ground.normal / np.linalg.norm(ground.normal)
        axis = np.cross([0.0, 0, 1], normal)
        sine = float(np.linalg.norm(axis))
        axis = axis / sine if sine > 1e-9 else np.array([1.0, 0, 0])
        turn = SO3.exp(axis * math.atan2(sine, float(normal[2])))
        self.scene.add_grid(
            "/ground", width=12 * self.size, height=12 * self.size, cell_size=self.size / 4, section_size=self.size,
            cell_color=(170, 170, 170), section_color=(110, 110, 110),
            wxyz=turn.wxyz, position=normal * ground.height,
        )  # fmt: skip


def _finite(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) without those that are missing (NaN), float32."""
    return points[np.isfinite(points).all(1)].astype(np.float32)
