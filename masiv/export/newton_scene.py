"""Simulate a twin with the implicit MPM solver of Newton (https://github.com/newton-physics/newton).

    pip install newton numpy
    python scene.py --frames 24          (--device cuda:0 on a GPU)

Reads scene.json and particles.npz from its own folder and writes rollout.npz there: positions (frames, Q, 3) float32
[m] at times (frames,) [s]. Axes are those of the twin's world, SI units. Written for the API of Newton 1.8.
"""

import argparse
import json
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parent


def load(folder=FOLDER):
    """The settings of scene.json, and the arrays of particles.npz: positions (Q, 3) [m], velocities (Q, 3) [m/s] and
    masses (Q,) [kg], which are zero where a particle is held."""
    with np.load(folder / "particles.npz") as file:
        particles = {name: file[name] for name in file.files}
    return json.loads((folder / "scene.json").read_text(encoding="utf-8")), particles


def build(settings, particles):
    """The model and its solver."""
    import newton
    from newton.solvers import SolverImplicitMPM

    builder = newton.ModelBuilder()
    SolverImplicitMPM.register_custom_attributes(builder)
    count = len(particles["positions"])
    builder.add_particles(
        pos=particles["positions"].tolist(),
        vel=particles["velocities"].tolist(),
        mass=particles["masses"].tolist(),
        radius=[settings["particle_radius_m"]] * count,
        custom_attributes={f"mpm:{name}": [value] * count for name, value in settings["material"].items()},
    )
    ground = settings["ground"]
    if ground is not None:
        contact = newton.ModelBuilder.ShapeConfig(mu=ground["friction"])
        builder.add_shape_plane(plane=(*ground["normal"], -ground["height_m"]), width=0, length=0, cfg=contact)
    model = builder.finalize()
    model.set_gravity(tuple(settings["gravity_m_s2"]))
    grid = "sparse" if model.device.is_cuda else "dense"
    # Without a warm start: those of Newton 1.8 made soft bodies diverge.
    config = SolverImplicitMPM.Config(
        voxel_size=settings["voxel_size_m"], grid_type=grid, air_drag=0.0, warmstart_mode="none"
    )
    return model, SolverImplicitMPM(model, config=config)


def simulate(settings, particles, frames, substeps):
    """Positions (frames, Q, 3) [m] at k / fps, frame 0 included."""
    model, solver = build(settings, particles)
    now, after = model.state(), model.state()
    positions = [now.particle_q.numpy().copy()]  # on a CPU, numpy() is a view
    for _ in range(frames - 1):
        for _ in range(substeps):
            solver.step(now, after, None, None, 1 / (settings["fps"] * substeps))
            now, after = after, now
        positions.append(now.particle_q.numpy().copy())
    return np.stack(positions).astype(np.float32)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--substeps", type=int, default=10, help="time steps a frame")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=FOLDER / "rollout.npz")
    options = parser.parse_args()
    import warp

    settings, particles = load()
    with warp.ScopedDevice(options.device):
        positions = simulate(settings, particles, options.frames, options.substeps)
    np.savez_compressed(options.out, positions=positions, times=np.arange(options.frames) / settings["fps"])
    print(options.out)


if __name__ == "__main__":
    main()
