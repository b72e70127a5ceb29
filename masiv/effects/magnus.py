"""Lift of a spinning body in air."""

import taichi as ti

from masiv.effects.context import EffectParameter
from masiv.effects.effect import NodalEffect
from masiv.effects.search_hints import SearchHints


@ti.func
def _turned(x, v, t, dt, dx, c):
    half = 0.5 * dt * ti.Vector([c[0], c[1], c[2]])
    return v + (2.0 / (1.0 + half.dot(half))) * half.cross(v + half.cross(v))


class Magnus(NodalEffect):
    r"""$\dot v = k \times v$: a lift across path and spin, which turns the velocity and keeps the speed.

    $k$ is along the spin $\omega$, which is taken as constant. On a sphere of radius $r$ and mass $m$ in a medium of
    density $\rho$, $k = C_L \rho \pi r^2 |v| \omega / (2 m |\omega|)$. The lift coefficient of a baseball is about
    $r |\omega| / |v|$ where that is 0.1 to 0.3 (Nathan 2008); then $k = \rho \pi r^3 \omega / (2 m)$. A substep rotates
    $v$ by $2 \arctan(\Delta t |k| / 2)$, as Boris (1970) does in a magnetic field. If the spin is not along $k$, the
    effect turns the spin as well, which no lift does. Looked for on request: a short path hardly distinguishes it from
    a force.
    """

    name = "magnus"
    looks_like = "a spinning body swerves, across its path and its spin: curve balls, topspin that dips"
    parameters = tuple(EffectParameter(f"lift_rate_{axis}", "1/s", -10.0, 10.0, 0.02) for axis in "xyz")
    strengths = 3
    hints = SearchHints(on_request=True)

    def node_velocity(self):
        return _turned
