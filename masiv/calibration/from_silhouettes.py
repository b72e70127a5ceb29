"""Cameras corrected by their silhouettes alone, before anything is reconstructed.

Bundle adjustment of the epipolar tangency residuals of all pairs of cameras (``frontier``) with the prior of the
corrections and without the gauge (``gauge``): Gauss-Newton steps with the weights of Student's distribution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from masiv.calibration.config import CalibrationPrior
from masiv.calibration.consistency import pair_errors, consistency
from masiv.calibration.frontier import Outlines, TangencyResiduals, tangency_residuals, world_rays
from masiv.calibration.gauge import (
    POSE,
    camera_precision,
    displacement_jacobian,
    gauge_free_steps,
    prior_deviations,
    scaled_deviations,
)
from masiv.calibration.tangency import outline
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene

NU = 4.0
STEPS = 40
MAX_FRAMES = 48
MIN_NOISE_PX = 0.02
CORR = True

@dataclass(frozen=True)
class ObjectPoints:
    pivot: np.ndarray
    points: np.ndarray
    velocities: np.ndarray


def object_points(cameras, outlines, fps, per_outline=8):
    means = np.stack([world_rays(c, h).mean(axis=1) for c, h in zip(cameras, outlines.hulls)])  # V F 3
    means /= np.linalg.norm(means, axis=-1, keepdims=True)
    projectors = np.eye(3) - means[..., :, None] * means[..., None, :]
    centres_cam = np.stack([c.centre for c in cameras])
    seen = np.isfinite(means).all(-1)
    projectors = np.where(seen[..., None, None], projectors, 0)
    count = seen.sum(axis=0)
    usable = np.flatnonzero(count >= 2)
    A = projectors[:, usable].sum(axis=0); b = np.einsum('vfij,vj->fi', projectors[:, usable], centres_cam)
    centres = np.linalg.solve(A + 1e-9*np.eye(3), b[..., None])[..., 0]
    frames = outlines.frames[usable]
    vel = np.gradient(centres, frames / fps, axis=0) if len(frames) > 1 else np.zeros_like(centres)
    pts, vs = [], []
    for c, h in zip(cameras, outlines.hulls):
        k = np.linspace(0, h.shape[1], per_outline, endpoint=False).astype(int)
        rays = world_rays(c, h[usable][:, k]); rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        depth = ((centres - c.centre)[:, None] * rays).sum(-1)
        p = c.centre + depth[..., None] * rays
        ok = np.isfinite(p).all(-1)
        pts.append(p[ok]); vs.append(np.broadcast_to(vel[:, None], p.shape)[ok])
    p = np.concatenate(pts)
    return ObjectPoints(p.mean(axis=0), p, np.concatenate(vs))


@dataclass
class Fit:
    corrections: np.ndarray
    pivot: np.ndarray
    noise: float
    rho: float
    se: np.ndarray
    log: list


def fit(cameras, outlines, raw, fps, prior, time_offsets, clock=True, scaled=True, corr=True, nu=NU, maxit=STEPS):
    o = object_points(cameras, outlines, fps)
    dev = prior_deviations(cameras, o.pivot, fps, prior)
    if scaled:
        inc = consistency(tuple(range(len(cameras))), pair_errors(list(cameras), raw)).pixels
        dev = scaled_deviations(dev, inc, cameras, o.pivot, o.points, o.velocities)
    if not clock:
        dev[:, 7] *= 1e-4
    V = len(cameras)
    L = gauge_free_steps(cameras, o.pivot, o.points, o.velocities, dev)
    whitening = np.zeros_like(L)
    precision = np.zeros_like(L)
    for v, c in enumerate(cameras):
        rows = slice(POSE*v, POSE*(v+1))
        precision[rows, rows] = camera_precision(c, o.pivot, dev[v])
    # orthonormal-ish basis
    scale = np.sqrt(1/np.diag(precision))
    U, S, _ = np.linalg.svd(L / scale[:, None])
    B = scale[:, None] * U[:, : POSE*V - POSE]
    P = B.T @ precision @ B
    z = np.zeros(B.shape[1]); log = []
    pj = np.zeros((V, len(o.points), 2, POSE))
    for v, c in enumerate(cameras): pj[v] = displacement_jacobian(c, o.pivot, o.points, o.velocities)
    noise, rho, df = None, 0.0, 0.0
    for it in range(maxit):
        x = (B @ z).reshape(V, POSE)
        res = tangency_residuals(cameras, outlines, x, o.pivot, fps, time_offsets)
        r = res.angles / res.lengths
        J = np.zeros((len(r), V, POSE)); n = np.arange(len(r))
        for s in (0, 1): J[n, res.pairs[:, s]] = res.jacobian[:, s] / res.lengths[:, None]
        J = J.reshape(len(r), -1) @ B
        if noise is None: noise = max(1.4826*np.median(abs(r)), MIN_NOISE_PX)
        for _ in range(3):
            w = (nu + 1) / (nu + (r/noise)**2)
            noise = max(np.sqrt((w*r*r).sum() / max(len(r) - df, 1)), MIN_NOISE_PX)
        # intraclass corr
        q = np.sqrt(w) * r / noise
        counts = np.bincount(res.groups)
        sums = np.bincount(res.groups, q)
        G = (counts > 0).sum()
        between = (sums**2).sum() - (q**2).sum()      # sum over pairs within group
        npairs = (counts*(counts-1.0)).sum()
        rho = float(np.clip(between / max(npairs,1) / (q**2).mean(), 0, 1)) if corr and npairs>0 else 0.
        eff = 1/(1+(counts[res.groups]-1)*rho)
        W = w/noise**2*eff
        H0 = J.T @ (W[:, None]*J)
        g = J.T @ (W*r) + P @ z
        H = H0 + P
        df = np.trace(np.linalg.solve(H, H0))
        step = -np.linalg.solve(H, g)
        z = z + step
        dx = (B @ step).reshape(V, POSE)
        moved = np.sqrt(((pj @ dx[:, None, :, None])[..., 0]**2).sum(-1).mean(-1)).max()
        log.append((it, noise, rho, df, moved, np.median(abs(r))))
        if moved < 1e-3: break
    C = B @ np.linalg.inv(H) @ B.T
    se = np.array([np.sqrt(np.einsum('pij,jk,pik->p', pj[v], C[8*v:8*v+8, 8*v:8*v+8], pj[v]).mean()) for v in range(V)])
    return Fit((B @ z).reshape(V, POSE), o.pivot, noise, rho, se, log)
