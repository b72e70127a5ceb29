"""Measured points as the observation: motion capture, heights, tracked points. Reading needs no torch and no taichi."""
