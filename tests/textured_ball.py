"""Points and colours of a textured ball, and cameras around it."""

from __future__ import annotations

import numpy as np

from masiv.scene.camera import Camera

SIDE, FRAMES, FPS = 40, 4, 24.0


def ball(count=400):
    """Points on a sphere of radius 0.2 m around (0, 0.5, 0), with colours in large patches."""
    k = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    unit = np.stack([np.cos(turn) * np.sin(polar), np.cos(polar), np.sin(turn) * np.sin(polar)], axis=1)
    return unit, 0.5 + 0.4 * np.sin(4 * unit + np.array([0.0, 1.0, 2.0]))


def camera_at(angle, height):
    eye = np.array([1.2 * np.sin(angle), height, 1.2 * np.cos(angle)])
    forward = np.array([0, 0.45, 0]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return Camera(f"{angle:.1f}", SIDE, SIDE, np.array([[55.0, 0, SIDE / 2], [0, 55.0, SIDE / 2], [0, 0, 1]]), pose)
