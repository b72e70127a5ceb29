"""Measured points as the observation: motion capture, tracked points, heights. Reading is light: no torch, no taichi."""
