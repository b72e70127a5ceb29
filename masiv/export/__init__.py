"""Results in the formats of other programs: ParaView, Blender, 3D Gaussian splatting, Newton, spreadsheets.

Every function writes one file or one folder, complete or not at all, in metres and seconds. Motions are rollouts:
``masiv.simulate`` returns one, and so does ``Rollout(trajectory.positions, trajectory.times)``. Formats and recipes:
docs/export.md. Most formats need the libraries of ``pip install 'masiv[export]'``.

Example:
    rollout = masiv.simulate(twin, frames=40)
    masiv.export.write_vtkhdf(rollout, "motion.vtkhdf")
    masiv.export.write_usd(rollout, "motion.usdc", up=twin.up)
"""

from masiv.export.gaussians import follow_gaussians, write_gaussians
from masiv.export.gltf import write_glb
from masiv.export.kinematics import particle_spacing, velocities
from masiv.export.law import law_curves, write_law_csv
from masiv.export.newton import write_newton_scene
from masiv.export.obj import write_obj_sequence
from masiv.export.ply import write_ply_sequence
from masiv.export.surface import Surface, carried_surface, reconstruct_surface
from masiv.export.usd import write_usd
from masiv.export.vtkhdf import write_vtkhdf

__all__ = [
    "Surface",
    "carried_surface",
    "follow_gaussians",
    "law_curves",
    "particle_spacing",
    "reconstruct_surface",
    "velocities",
    "write_gaussians",
    "write_glb",
    "write_law_csv",
    "write_newton_scene",
    "write_obj_sequence",
    "write_ply_sequence",
    "write_usd",
    "write_vtkhdf",
]
