"""A run folder made by hand: every file that a run of pictures leaves, of 27 particles, without running a stage."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch

from masiv.checkpoint import Checkpoint
from masiv.config import load_config
from masiv.continuum.trajectory import Trajectory
from masiv.files import write_json, write_npz
from masiv.materials.classical import ClassicalLaw
from masiv.mpm.config import SimulatorConfig
from masiv.observations.kept_masks import KeptMasks
from masiv.refinement.answer import SCHEMA
from masiv.report.sections.material import MATERIAL
from masiv.report.sections.refinement import FIELDS, REFINED
from masiv.runfolder import Request, RunFolder
from masiv.scene.calibration import Calibration
from masiv.scene.camera import Camera
from masiv.scene.scene import Ground
from masiv.simulation.rollout import Rollout
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.dynamic import DynamicGaussians
from masiv.splat.gaussians import Gaussians
from masiv.twin import Twin

FRAMES, FPS = 3, 24.0
UP = np.array([0.0, 1.0, 0.0])
KEY = "made by hand"


def write_run(folder: Path) -> RunFolder:
    """The run, all of whose stages are done, but for a checkpoint of identify."""
    side = np.arange(3) * 0.1
    rest = np.stack(np.meshgrid(side, side + 0.5, side, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    network = DeformationNetwork(
        centre=torch.tensor([0.1, 0.6, 0.1]), half_extent=0.2, base_motion=torch.zeros(FRAMES, 3),
        frame_count=FRAMES, fps=FPS, bases=2, width=4, depth=1,
    )  # fmt: skip
    positions = np.stack([rest - 0.01 * frame * UP for frame in range(FRAMES)]).astype(np.float32)
    times = np.arange(FRAMES) / FPS
    scene = {"layout": "pacnerf", "fps": FPS, "frames": FRAMES, "views": 1}
    config = load_config("quick").model_dump(mode="json")
    run = RunFolder.create_or_resume(folder, Request(config, folder.parent / "scene", scene, FRAMES))
    for stage in ("reconstruct", "trajectory", "identify"):
        with run.stage(stage):
            pass
    pose = np.eye(4)
    pose[2, 3] = 2.0
    camera = Camera("view 0", 32, 32, np.array([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]]), pose)
    points = torch.from_numpy(rest)
    gaussians = Gaussians(points, torch.full((27,), 0.05), torch.full((27,), 0.5), torch.full((27, 3), 0.5))
    DynamicGaussians(gaussians, network, Calibration((camera,), (camera,), (0.0,), (0.0,))).save(folder)
    Trajectory(positions, times, 0.1, 0.027, network).save(run.trajectory)
    Rollout(positions, times).save(run.rollout)
    law = ClassicalLaw("neo_hookean", youngs_modulus=1e4, poissons_ratio=0.3)
    Twin.of_body(
        positions=rest, velocity=np.zeros(3), omega=np.zeros(3), gravity=-9.8 * UP, ground=Ground(UP, 0.0),
        contact="sticky", volume=0.027, density=1000.0, up=UP, fps=FPS, law=law, simulator=SimulatorConfig(),
    ).save(folder)  # fmt: skip
    write_json(folder / MATERIAL, {"schema": 1, "summary": "soft"})
    write_json(folder / REFINED, {"schema": SCHEMA})
    names = ("before", "after", "observed", "points", "times", "fit_count", "test_count")
    write_npz(folder / FIELDS, observations=["a"], **{f"{name}@a": np.zeros(3) for name in names})
    write_json(run.metrics, {"schema": 1})
    KeptMasks(run.masks, KEY).write("view_0_0000", {0: np.ones((4, 4), np.float32)})
    Checkpoint(run.checkpoint("identify").path).save({"step": 3, "weights": torch.ones(8)})
    return run


def write_scene(folder: Path, frames: int = 2) -> Path:
    """A scene in the layout of PAC-NeRF: two cameras that face each other, and scene.yaml."""
    import cv2

    (folder / "data").mkdir(parents=True)
    rows = []
    for view, sign in ((0, 1.0), (1, -1.0)):
        for frame in range(frames):
            image = np.full((32, 32, 3), 90, np.uint8)
            image[8 + frame : 18 + frame, 10:20] = (20, 20, 220)
            cv2.imwrite(str(folder / f"data/r_{view}_{frame}.png"), image)
            pose = np.column_stack([np.diag([sign, 1.0, sign]), [0, 0.5, 2 * sign]]).tolist()
            intrinsic = [[40, 0, 16], [0, 40, 16], [0, 0, 1]]
            name = f"./data/r_{view}_{frame}.png"
            rows.append({"file_path": name, "c2w": pose, "intrinsic": intrinsic, "time": frame / FPS})
    (folder / "all_data.json").write_text(json.dumps(rows))
    (folder / "scene.yaml").write_text("density: 1000\nground: {normal: [0, 1, 0], height: 0}\n")
    return folder
