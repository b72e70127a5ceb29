"""Front-to-back alpha blending of projected Gaussians, and its adjoint (Kerbl et al. 2023, "3D Gaussian splatting").

    power = -(A dx^2 + C dy^2) / 2 - B dx dy,  alpha = min(0.99, opacity exp(power)),  w = T alpha,  T <- T (1 - alpha)

A Gaussian is skipped at a pixel where alpha < 1/255, and a pixel is finished once T (1 - alpha) would fall below 1e-4.

One thread owns one tile, so a picture needs no atomics; each (Gaussian, tile) pair, called a slot, has a gradient of
its own, and the slots of a Gaussian are summed in a fixed order. So both directions are reproducible to the bit. Inside
a tile the loop over Gaussians is the outer one: it visits only the pixels of the Gaussian's own box, and gradients stay
in registers.
"""

from functools import cache

import taichi as ti

TILE = 16
"""Side of a tile [pixels]."""
CHANNELS = 5
"""Blended channels: red, green, blue, one (alpha), depth."""
SPLAT_SIZE = 10
"""Entries of a projected Gaussian: u, v, conic A, B, C, opacity, red, green, blue, depth."""

LOW_PASS = 0.3
"""Added to the variance of a projected Gaussian [pixels^2]: it never falls between pixels (Kerbl et al. 2023)."""
NEAR = 0.01
"""Gaussians nearer to the camera plane than this [m] are not drawn."""
ALPHA_SKIP, ALPHA_LIMIT = 1.0 / 255.0, 0.99
"""Opacity at a pixel below which a Gaussian is skipped, and its largest value."""
STOP = 1e-4
"""A pixel is finished when its transmittance would fall below this."""

NUMBERS = ti.types.ndarray(ndim=1)
ROWS = ti.types.ndarray(ndim=2)
IMAGE = ti.types.ndarray(ndim=3)
INDICES = ti.types.ndarray(dtype=ti.i32, ndim=1)
BOXES = ti.types.ndarray(dtype=ti.i32, ndim=2)


@cache
def kernels(real):
    """One ``RasteriseKernels`` for each Taichi type."""
    return RasteriseKernels(real)


@ti.data_oriented
class RasteriseKernels:
    """Projection, blending and their adjoints for the Taichi type ``real`` (ti.f32 or ti.f64).

    camera (17,): rotation (row by row) and translation from the world, then fx, skew, fy, cx, cy; splats (N, 10);
    boxes (N, 4) int32: pixels x0, y0, x1, y1 (half-open) that a Gaussian can reach, empty if it is not drawn;
    tile_start (tiles + 1,) int32 into ``members`` (Gaussian, front to back within a tile) and ``slots``; image
    (H, W, 5); transmittance (H, W), ones at first.
    """

    def __init__(self, real):
        self.real = real

    @ti.func
    def features(self, splats: ti.template(), g):
        return ti.Vector([splats[g, 6], splats[g, 7], splats[g, 8], self.real(1.0), splats[g, 9]])

    @ti.func
    def in_camera(self, camera: ti.template(), means: ti.template(), g):
        """The mean in the camera's axes."""
        return ti.Vector([
            camera[3 * i] * means[g, 0] + camera[3 * i + 1] * means[g, 1] + camera[3 * i + 2] * means[g, 2]
            + camera[9 + i] for i in ti.static(range(3))
        ])  # fmt: skip

    @ti.kernel
    def project(
        self,
        camera: NUMBERS,
        means: ROWS,
        scales: NUMBERS,
        opacities: NUMBERS,
        colors: ROWS,
        splats: ROWS,
        boxes: BOXES,
        width: ti.i32,
        height: ti.i32,
    ):
        """EWA projection (Zwicker et al. 2001). Rows of its Jacobian are (fx, skew, -u) / z and (0, fy, -v) / z."""
        for g in range(means.shape[0]):
            fx, skew, fy = camera[12], camera[13], camera[14]
            p = self.in_camera(camera, means, g)
            near = p[2] <= self.real(NEAR)
            inverse = self.real(1.0) / (self.real(1.0) if near else p[2])
            u, v = (fx * p[0] + skew * p[1]) * inverse, fy * p[1] * inverse
            spread, low_pass = (scales[g] * inverse) ** 2, self.real(LOW_PASS)
            xx = spread * (fx * fx + skew * skew + u * u) + low_pass
            xy = spread * (skew * fy + u * v)
            yy = spread * (fy * fy + v * v) + low_pass
            determinant = xx * yy - xy * xy
            u += camera[15]
            v += camera[16]
            splats[g, 0], splats[g, 1] = u, v
            splats[g, 2], splats[g, 3], splats[g, 4] = yy / determinant, -xy / determinant, xx / determinant
            splats[g, 5] = opacities[g]
            for i in ti.static(range(3)):
                splats[g, 6 + i] = colors[g, i]
            splats[g, 9] = p[2]
            weakest = self.real(ALPHA_SKIP) / opacities[g]
            reach = ti.sqrt(-2.0 * ti.log(ti.min(weakest, self.real(1.0))))
            low_x = ti.max(ti.ceil(u - reach * ti.sqrt(xx) - 0.5), 0.0)
            low_y = ti.max(ti.ceil(v - reach * ti.sqrt(yy) - 0.5), 0.0)
            high_x = ti.min(ti.floor(u + reach * ti.sqrt(xx) - 0.5) + 1.0, self.real(width))
            high_y = ti.min(ti.floor(v + reach * ti.sqrt(yy) - 0.5) + 1.0, self.real(height))
            drawn = not near and opacities[g] > self.real(ALPHA_SKIP) and high_x > low_x and high_y > low_y
            boxes[g, 0] = ti.cast(low_x, ti.i32) if drawn else 0
            boxes[g, 1] = ti.cast(low_y, ti.i32) if drawn else 0
            boxes[g, 2] = ti.cast(high_x, ti.i32) if drawn else 0
            boxes[g, 3] = ti.cast(high_y, ti.i32) if drawn else 0

    @ti.kernel
    def blend(
        self,
        splats: ROWS,
        boxes: BOXES,
        tile_start: INDICES,
        members: INDICES,
        image: IMAGE,
        transmittance: ROWS,
        columns: ti.i32,
    ):
        for tile in range(tile_start.shape[0] - 1):
            left = tile % columns * TILE
            top = tile // columns * TILE
            for k in range(tile_start[tile], tile_start[tile + 1]):
                g = members[k]
                u, v, a, b, c, o = splats[g, 0], splats[g, 1], splats[g, 2], splats[g, 3], splats[g, 4], splats[g, 5]
                f = self.features(splats, g)
                min_power = ti.log(self.real(ALPHA_SKIP) / o)  # spares the exponential where alpha is skipped
                for y in range(ti.max(top, boxes[g, 1]), ti.min(top + TILE, boxes[g, 3])):
                    for x in range(ti.max(left, boxes[g, 0]), ti.min(left + TILE, boxes[g, 2])):
                        t = transmittance[y, x]
                        if t < 0.0:  # finished
                            continue
                        dx = self.real(x + 0.5) - u
                        dy = self.real(y + 0.5) - v
                        power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
                        if power > 0.0 or power < min_power:
                            continue
                        alpha = ti.min(self.real(ALPHA_LIMIT), o * ti.exp(power))
                        after = t * (1.0 - alpha)
                        if after < STOP:
                            transmittance[y, x] = -t
                            continue
                        transmittance[y, x] = after
                        w = t * alpha
                        for i in ti.static(range(CHANNELS)):
                            image[y, x, i] = image[y, x, i] + w * f[i]

    @ti.kernel
    def blend_adjoint(
        self,
        splats: ROWS,
        boxes: BOXES,
        tile_start: INDICES,
        members: INDICES,
        slots: INDICES,
        image_bar: IMAGE,
        transmittance: ROWS,
        behind: ROWS,
        slot_bar: ROWS,
        columns: ti.i32,
    ):
        """Walks front to back again. ``behind`` (H, W) starts as <image_bar, image> and loses w <image_bar, f> for
        each Gaussian, so that d alpha = T <image_bar, f> - behind / (1 - alpha)."""
        for tile in range(tile_start.shape[0] - 1):
            left = tile % columns * TILE
            top = tile // columns * TILE
            for k in range(tile_start[tile], tile_start[tile + 1]):
                g = members[k]
                u, v, a, b, c, o = splats[g, 0], splats[g, 1], splats[g, 2], splats[g, 3], splats[g, 4], splats[g, 5]
                f = self.features(splats, g)
                min_power = ti.log(self.real(ALPHA_SKIP) / o)  # spares the exponential where alpha is skipped
                bar = ti.Vector.zero(self.real, SPLAT_SIZE)
                for y in range(ti.max(top, boxes[g, 1]), ti.min(top + TILE, boxes[g, 3])):
                    for x in range(ti.max(left, boxes[g, 0]), ti.min(left + TILE, boxes[g, 2])):
                        t = transmittance[y, x]
                        if t < 0.0:
                            continue
                        dx = self.real(x + 0.5) - u
                        dy = self.real(y + 0.5) - v
                        power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
                        if power > 0.0 or power < min_power:
                            continue
                        gauss = ti.exp(power)
                        alpha = ti.min(self.real(ALPHA_LIMIT), o * gauss)
                        after = t * (1.0 - alpha)
                        if after < STOP:
                            transmittance[y, x] = -t
                            continue
                        transmittance[y, x] = after
                        w = t * alpha
                        q = self.real(0.0)
                        for i in ti.static(range(CHANNELS)):
                            q += image_bar[y, x, i] * f[i]
                        rest = behind[y, x] - w * q
                        behind[y, x] = rest
                        for i in ti.static(range(3)):
                            bar[6 + i] += w * image_bar[y, x, i]
                        bar[9] += w * image_bar[y, x, 4]
                        if o * gauss < ALPHA_LIMIT:
                            alpha_bar = t * q - rest / (1.0 - alpha)
                            power_bar = alpha_bar * alpha
                            bar[0] += power_bar * (a * dx + b * dy)
                            bar[1] += power_bar * (c * dy + b * dx)
                            bar[2] -= power_bar * 0.5 * dx * dx
                            bar[3] -= power_bar * dx * dy
                            bar[4] -= power_bar * 0.5 * dy * dy
                            bar[5] += alpha_bar * gauss
                s = slots[k]
                for i in ti.static(range(SPLAT_SIZE)):
                    slot_bar[s, i] = bar[i]

    @ti.kernel
    def project_adjoint(
        self,
        camera: NUMBERS,
        means: ROWS,
        scales: NUMBERS,
        splats: ROWS,
        slot_bar: ROWS,
        first_slot: INDICES,
        means_bar: ROWS,
        scales_bar: NUMBERS,
        splat_bar: ROWS,
    ):
        """splat_bar (N, 10): the sum of each Gaussian's slots first_slot[g] ... first_slot[g + 1] - 1, in order; from
        there to means and scales. The conic is the inverse of the covariance C, so C_bar = -C^-1 conic_bar C^-1."""
        for g in range(splat_bar.shape[0]):
            total = ti.Vector.zero(self.real, SPLAT_SIZE)
            for s in range(first_slot[g], first_slot[g + 1]):
                for i in ti.static(range(SPLAT_SIZE)):
                    total[i] += slot_bar[s, i]
            for i in ti.static(range(SPLAT_SIZE)):
                splat_bar[g, i] = total[i]
            fx, skew, fy = camera[12], camera[13], camera[14]
            p = self.in_camera(camera, means, g)
            near = p[2] <= self.real(NEAR)
            inverse = self.real(1.0) / (self.real(1.0) if near else p[2])
            u, v = (fx * p[0] + skew * p[1]) * inverse, fy * p[1] * inverse
            q = scales[g] * inverse
            a, b, c = splats[g, 2], splats[g, 3], splats[g, 4]
            half = total[3] * 0.5
            left = ti.Vector(
                [a * total[2] + b * half, a * half + b * total[4], b * total[2] + c * half, b * half + c * total[4]]
            )
            xx_bar = -(left[0] * a + left[1] * b)
            xy_bar = -2.0 * (left[0] * b + left[1] * c)
            yy_bar = -(left[2] * b + left[3] * c)
            spread = q * q
            spread_bar = (
                xx_bar * (fx * fx + skew * skew + u * u) + xy_bar * (skew * fy + u * v) + yy_bar * (fy * fy + v * v)
            )
            u_bar = total[0] + spread * (2.0 * u * xx_bar + v * xy_bar)
            v_bar = total[1] + spread * (u * xy_bar + 2.0 * v * yy_bar)
            q_bar = 2.0 * q * spread_bar
            inverse_bar = q_bar * scales[g] + u_bar * (fx * p[0] + skew * p[1]) + v_bar * fy * p[1]
            x_bar = u_bar * fx * inverse
            y_bar = (u_bar * skew + v_bar * fy) * inverse
            z_bar = total[9] - (self.real(0.0) if near else inverse_bar * inverse * inverse)
            scales_bar[g] = q_bar * inverse
            for i in ti.static(range(3)):
                means_bar[g, i] = camera[i] * x_bar + camera[3 + i] * y_bar + camera[6 + i] * z_bar
