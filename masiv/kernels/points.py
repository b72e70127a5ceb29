"""Mass points in free flight: the effects' own functions of velocity on points instead of nodes of a grid."""

import functools

import taichi as ti

REAL = ti.f64


@ti.data_oriented
class PointKernels:
    """functions: of ``NodalEffect.node_velocity``, in order; widths: coefficients of each."""

    def __init__(self, functions, widths):
        self.members = tuple(zip(functions, widths, (sum(widths[:k]) for k in range(len(widths))), strict=True))

    @ti.kernel
    def fly(
        self, start: ti.types.ndarray(), gravity: ti.types.ndarray(), coefficients: ti.types.ndarray(),
        times: ti.types.ndarray(), counts: ti.types.ndarray(), size: REAL, out: ti.types.ndarray(),
    ):  # fmt: skip
        """start (B, 6): place [m] and velocity [m/s] at times[0]; gravity (3,); coefficients (B, C); times (T,) [s];
        counts (T,) int32: substeps since the time before; size [m] of the body; out (B, T, 3) [m].

        Gravity in two halves round the effects and the mean velocity of a substep: of second order, and exact under
        gravity alone.
        """
        for b in range(start.shape[0]):
            x = ti.Vector([start[b, 0], start[b, 1], start[b, 2]])
            v = ti.Vector([start[b, 3], start[b, 4], start[b, 5]])
            g = ti.Vector([gravity[0], gravity[1], gravity[2]])
            for i in ti.static(range(3)):
                out[b, 0, i] = x[i]
            for k in range(1, times.shape[0]):
                dt = (times[k] - times[k - 1]) / counts[k]
                for s in range(counts[k]):
                    t = times[k - 1] + s * dt
                    before = v
                    v += 0.5 * dt * g
                    for member in ti.static(self.members):
                        c = ti.Vector([coefficients[b, member[2] + i] for i in range(member[1])])
                        v = member[0](x, v, t, dt, size, c)
                    v += 0.5 * dt * g
                    x += 0.5 * dt * (before + v)
                for i in ti.static(range(3)):
                    out[b, k, i] = x[i]


@functools.lru_cache(maxsize=128)
def point_kernels(effects):
    """One a tuple of (effect, number of its coefficients)."""
    return PointKernels(tuple(e.node_velocity() for e, _ in effects), tuple(n for _, n in effects))
