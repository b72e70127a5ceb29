"""Laws of Hencky strain: their kernels against return mappings by numpy's singular value decomposition."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

COUNT = 300
LAWS = {  # mu = 1/2, so that stresses are in units of 2 mu
    "von_mises": (0.5, 0.7, 0.01),
    "non_newtonian": (0.5, 0.7, 0.01, 3.0),
    "drucker_prager": (0.5, 0.7, 0.3),
}


def deformations():
    rng = np.random.default_rng(0)
    eye, noise = np.eye(3), rng.normal(size=(COUNT, 3, 3))

    def turned(stretches):
        first, second = (Rotation.random(COUNT, random_state=rng).as_matrix() for _ in range(2))
        return first @ (stretches[:, :, None] * second)

    large = np.exp(rng.uniform(np.log(0.2), np.log(5), (COUNT, 3)))
    twice = large[:, [0, 0, 2]]
    nearly = twice * (1 + 1e-5 * rng.normal(size=(COUNT, 3)))
    return {
        "rest": np.broadcast_to(eye, (COUNT, 3, 3)),
        "tiny": eye + 1e-6 * noise,
        "small": eye + 1e-3 * noise,
        "moderate": eye + 0.05 * noise,
        "small, turned": turned(1 + 1e-3 * noise[:, 0]),
        "at the limit of the series": turned(1 + 0.14 * np.sign(noise[:, 0])),
        "large": turned(large),
        "repeated": turned(twice),
        "nearly repeated": turned(nearly),
        "isotropic": turned(large[:, [0, 0, 0]]),
        "diagonal": large[:, :, None] * eye,
        "nearly singular": turned(np.array([1.0, 0.8, 1e-3]) * np.ones((COUNT, 1))),
    }


DEFORMATIONS = deformations()


def mapped(kind, f, c):
    """F and tau after the return mapping, in float64, and where nothing flows."""
    u, s, vt = np.linalg.svd(f.astype(np.float64))
    strain = np.log(s)
    trace = strain.sum(1, keepdims=True)
    deviator = strain - trace / 3
    size = np.maximum(np.linalg.norm(deviator, axis=1, keepdims=True), 1e-300)
    if kind == "drucker_prager":
        excess = size + (3 * c[1] + 2 * c[0]) / (2 * c[0]) * trace * c[2]
        kept = np.where(trace >= 0, 0, strain - np.maximum(excess, 0) * deviator / size)
        elastic = (trace < -1e-5) & (excess < -1e-5)
    else:
        excess = size - c[2] / (2 * c[0])
        kept = strain - np.maximum(excess, 0) * deviator / size / (1 + (c[3] if kind == "non_newtonian" else 0))
        elastic = excess < -1e-5
    principal = 2 * c[0] * kept + c[1] * kept.sum(1, keepdims=True)
    return u @ (np.exp(kept)[:, :, None] * vt), (u * principal[:, None]) @ u.swapaxes(1, 2), elastic[:, 0]


@pytest.fixture(scope="module")
def apply(taichi):
    """A function (kind, F) -> (F, tau) of the kernels, in the precision of F; what was compiled is kept."""
    from masiv.kernels.laws import law_function

    def compiled(kind, real):
        before, after, stress = (taichi.Matrix.field(3, 3, real, shape=COUNT) for _ in range(3))
        coefficients = taichi.Vector.field(len(LAWS[kind]), real, shape=())
        coefficients[None] = LAWS[kind]
        law = law_function(kind)

        @taichi.kernel
        def kernel():
            for p in before:
                f, tau = law(before[p], coefficients[None])
                after[p] = f
                stress[p] = tau

        def run(f):
            before.from_numpy(np.ascontiguousarray(f))
            kernel()
            return after.to_numpy(), stress.to_numpy()

        return run

    kernels = {}

    def apply(kind, f):
        real = taichi.f64 if f.dtype == np.float64 else taichi.f32
        if (kind, real) not in kernels:
            kernels[kind, real] = compiled(kind, real)
        return kernels[kind, real](f)

    return apply


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", LAWS)
@pytest.mark.parametrize("deformation", DEFORMATIONS)
def test_kernels_equal_the_return_mapping_by_singular_values(apply, deformation, kind, dtype):
    f = DEFORMATIONS[deformation].astype(dtype)
    expected, expected_stress, elastic = mapped(kind, f, np.array(LAWS[kind], dtype).astype(np.float64))
    ours, stress = apply(kind, f)
    singular = np.linalg.svd(f.astype(np.float64), compute_uv=False)
    # What F says of the smallest stretch is off by rounding times this ratio; in float64 numpy's is as large as ours.
    rounding = np.finfo(dtype).eps * np.maximum(singular[:, 0] / singular[:, 2], 5)[:, None, None]
    assert (np.abs(stress - expected_stress) < 20 * rounding).all()
    assert (np.abs(ours - expected) < 20 * rounding * np.abs(expected).max((1, 2), keepdims=True)).all()
    assert np.array_equal(ours[elastic], f[elastic])
    if deformation in ("tiny", "small") and kind != "drucker_prager":
        assert elastic.any()


@pytest.mark.parametrize("kind", ["von_mises", "non_newtonian"])
def test_a_small_strain_keeps_its_digits_in_float32(apply, kind):
    """To 1e-5 of itself: F holds a strain of 1e-6 to 1e-13 off its diagonal, and to 1e-7 on it."""
    f = (np.eye(3) + 1e-6 * np.random.default_rng(1).normal(size=(COUNT, 3, 3))).astype(np.float32)
    e = f.astype(np.float64) - np.eye(3)
    strain = 0.5 * (e + e.swapaxes(1, 2))
    expected = strain + 0.7 * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    ours, stress = apply(kind, f)
    assert np.array_equal(ours, f)
    np.testing.assert_allclose(stress, expected, rtol=0, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("kind", LAWS)
def test_a_body_turned_inside_out_is_not_finite(apply, kind):
    for f in (np.diag([1.0, 1.0, -1.0]), np.diag([0.5, -2.0, 3.0])):
        assert np.isnan(apply(kind, np.broadcast_to(f, (COUNT, 3, 3)).astype(np.float32))[1]).any()
