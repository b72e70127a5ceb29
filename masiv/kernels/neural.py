"""Kernels that apply the neural law to the fields of a simulator, and their adjoint.

The networks are functions of three numbers, and the law interpolates their values on a lattice
(``masiv.kernels.lattice``). The networks run once a rollout, not once a substep; the adjoint scatters to the lattice.
"""

import taichi as ti

from masiv.kernels import isotropic
from masiv.kernels.lattice import LATTICE_COUNTS, LATTICE_LOWER, LATTICE_STEP
from masiv.kernels.tensor import identity3


@ti.data_oriented
class NeuralKernels:
    """``moduli`` (nodes, 4): ln g1, ln g2, ln kappa, coupling of ``isotropic.stress`` [Pa]; ``flows`` (nodes, 2):
    -ln of the shares of strain that ``isotropic.flow`` keeps. ``*_bar`` are their adjoints by chunk."""

    def __init__(self, mpm):
        self.mpm = mpm
        self.owner = None  # the rollout whose tables the fields hold
        nodes = LATTICE_COUNTS[0] * LATTICE_COUNTS[1] * LATTICE_COUNTS[2]
        self.moduli = ti.Vector.field(4, mpm.real, shape=nodes)
        self.flows = ti.Vector.field(2, mpm.real, shape=nodes)
        self.strains = ti.field(mpm.real, shape=2)  # strain scale of the elastic and of the plastic features
        self.moduli_bar = ti.Vector.field(4, mpm.real, shape=(mpm.chunks, nodes))
        self.flows_bar = ti.Vector.field(2, mpm.real, shape=(mpm.chunks, nodes))
        self.flow_strain_bar = ti.field(mpm.real, shape=mpm.capacity_particles)

    @ti.kernel
    def write_tables(
        self,
        moduli: ti.types.ndarray(),
        flows: ti.types.ndarray(),
        strains: ti.types.ndarray(),
        count: ti.i32,
    ):
        """Tables (nodes, 4), (nodes, 2), and the two strain scales (2,); adjoints start at zero."""
        for n in range(moduli.shape[0]):
            for a in ti.static(range(4)):
                self.moduli[n][a] = moduli[n, a]
            for a in ti.static(range(2)):
                self.flows[n][a] = flows[n, a]
            for t in ti.static(range(self.mpm.chunks)):
                self.moduli_bar[t, n] = ti.Vector.zero(self.mpm.real, 4)
                self.flows_bar[t, n] = ti.Vector.zero(self.mpm.real, 2)
        for p in range(count):
            self.flow_strain_bar[p] = 0.0
        for a in ti.static(range(2)):
            self.strains[a] = strains[a]

    @ti.kernel
    def read_bars(self, moduli: ti.types.ndarray(), flows: ti.types.ndarray(), strain: ti.types.ndarray()):
        """Adjoints of what ``write_tables`` takes; strain (N,) by particle."""
        for n in range(moduli.shape[0]):
            for a in ti.static(range(4)):
                moduli[n, a] = 0.0
                for t in ti.static(range(self.mpm.chunks)):
                    moduli[n, a] += self.moduli_bar[t, n][a]
            for a in ti.static(range(2)):
                flows[n, a] = 0.0
                for t in ti.static(range(self.mpm.chunks)):
                    flows[n, a] += self.flows_bar[t, n][a]
        for p in range(strain.shape[0]):
            strain[p] = self.flow_strain_bar[p]

    # ---- features and the lattice --------------------------------------------------------------------------------

    @ti.func
    def features(self, invariants, strain):
        """``masiv.materials.neural.NeuralLaw.features``."""
        x = invariants[0] / strain
        square = strain * strain
        total = invariants[1] + invariants[2]
        size = ti.abs(x) + ti.sqrt(x * x + 1.0)
        volume = ti.log(size)
        if x < 0.0:
            volume = -volume
        shear = 0.5 * ti.log(1.0 + ti.max(total, 0.0) / square)
        return ti.Vector([volume, shear, (invariants[2] - invariants[1]) / (total + square)])

    @ti.func
    def features_adjoint(self, invariants, strain, bar):
        """Adjoints of the invariants and of the strain scale."""
        x = invariants[0] / strain
        square = strain * strain
        total, difference = invariants[1] + invariants[2], invariants[2] - invariants[1]
        root = 1.0 / ti.sqrt(x * x + 1.0)
        shear = ti.cast(0.0, self.mpm.real)
        if total > 0.0:
            shear = 0.5 / (square + total)
        below = 1.0 / (total + square)
        along = -bar[2] * difference * below * below
        out = ti.Vector(
            [
                bar[0] * root / strain,
                bar[1] * shear + along - bar[2] * below,
                bar[1] * shear + along + bar[2] * below,
            ]
        )
        slope = -bar[0] * root * x / strain - 2.0 * bar[1] * shear * total / strain + 2.0 * strain * along
        return out, slope

    @ti.func
    def locate(self, feature):
        """Lattice cell of a feature vector, position in it, and its derivative: 1 / step within the lattice, else 0."""
        cell = ti.Vector.zero(ti.i32, 3)
        inside = ti.Vector.zero(self.mpm.real, 3)
        slope = ti.Vector.zero(self.mpm.real, 3)
        for a in ti.static(range(3)):
            u = (feature[a] - LATTICE_LOWER[a]) / LATTICE_STEP
            if u > 0.0 and u < LATTICE_COUNTS[a] - 1.0:
                slope[a] = 1.0 / LATTICE_STEP
            u = ti.min(ti.max(u, 0.0), LATTICE_COUNTS[a] - 1.0)
            cell[a] = ti.min(ti.cast(u, ti.i32), LATTICE_COUNTS[a] - 2)
            inside[a] = u - cell[a]
        return cell, inside, slope

    @ti.func
    def sample(self, table: ti.template(), zero, cell, inside):
        out = zero
        for i, j, k in ti.static(ti.ndrange(2, 2, 2)):
            weight = (
                (inside[0] if i else 1.0 - inside[0])
                * (inside[1] if j else 1.0 - inside[1])
                * (inside[2] if k else 1.0 - inside[2])
            )
            out += weight * table[((cell[0] + i) * LATTICE_COUNTS[1] + cell[1] + j) * LATTICE_COUNTS[2] + cell[2] + k]
        return out

    @ti.func
    def sample_adjoint(self, table: ti.template(), table_bar: ti.template(), t: ti.i32, cell, inside, slope, bar):
        """Scatters to ``table_bar``; returns the adjoint of the features."""
        out = ti.Vector.zero(self.mpm.real, 3)
        for i, j, k in ti.static(ti.ndrange(2, 2, 2)):
            node = ((cell[0] + i) * LATTICE_COUNTS[1] + cell[1] + j) * LATTICE_COUNTS[2] + cell[2] + k
            x = inside[0] if i else 1.0 - inside[0]
            y = inside[1] if j else 1.0 - inside[1]
            z = inside[2] if k else 1.0 - inside[2]
            value = (x * y * z) * bar
            if ti.static(self.mpm.gpu):
                table_bar[t, node] += value
            else:
                table_bar[t, node] = table_bar[t, node] + value
            along = table[node].dot(bar)
            out += along * ti.Vector([(2 * i - 1) * y * z, (2 * j - 1) * x * z, (2 * k - 1) * x * y])
        return out * slope

    @ti.func
    def coefficients(self, table_value):
        """Interpolated moduli -> c of ``isotropic.stress``."""
        return ti.Vector([ti.exp(table_value[0]), ti.exp(table_value[1]), ti.exp(table_value[2]), table_value[3]])

    @ti.func
    def share(self, flow):
        """1 - exp(-flow), accurate for small flow too."""
        out = flow * (1.0 - 0.5 * flow * (1.0 - flow / 3.0))
        for a in ti.static(range(2)):
            if flow[a] >= 0.01:
                out[a] = 1.0 - ti.exp(-flow[a])
        return out

    # ---- the law -------------------------------------------------------------------------------------------------

    @ti.func
    def flow_particle(self, s: ti.i32, p: ti.i32):
        """Trial gradient -> elastic gradient."""
        trial = self.mpm.trial_gradient[s, p]
        strain = isotropic.isochoric_strain(trial)
        cell, inside, _ = self.locate(self.features(isotropic.invariants(strain), self.strains[1]))
        flow = self.sample(self.flows, ti.Vector.zero(self.mpm.real, 2), cell, inside)
        self.mpm.deformation_gradient[s, p] = isotropic.flow(trial, strain, self.share(flow))

    @ti.func
    def stress_particle(self, s: ti.i32, p: ti.i32):
        """Elastic gradient -> stress."""
        strain = isotropic.isochoric_strain(self.mpm.deformation_gradient[s, p])
        cell, inside, _ = self.locate(self.features(isotropic.invariants(strain), self.strains[0]))
        c = self.coefficients(self.sample(self.moduli, ti.Vector.zero(self.mpm.real, 4), cell, inside))
        self.mpm.kirchhoff_stress[s, p] = isotropic.stress(strain, c)

    @ti.kernel
    def forward(self, s: ti.i32, count: ti.i32):
        for p in range(count):
            self.flow_particle(s, p)
            self.stress_particle(s, p)

    @ti.func
    def stress_particle_adjoint(self, t: ti.i32, s: ti.i32, p: ti.i32):
        """Adds the stress's part to ``gradient_bar``."""
        f = self.mpm.deformation_gradient[s, p]
        strain = isotropic.isochoric_strain(f)
        final = isotropic.invariants(strain)
        cell, inside, slope = self.locate(self.features(final, self.strains[0]))
        c = self.coefficients(self.sample(self.moduli, ti.Vector.zero(self.mpm.real, 4), cell, inside))
        c_bar, log_j_bar, b_bar, b_inverse_bar = isotropic.stress_adjoint(strain, c, self.mpm.stress_bar[p])
        moduli_bar = ti.Vector([c_bar[0] * c[0], c_bar[1] * c[1], c_bar[2] * c[2], c_bar[3]])
        feature_bar = self.sample_adjoint(self.moduli, self.moduli_bar, t, cell, inside, slope, moduli_bar)
        bar, _ = self.features_adjoint(final, self.strains[0], feature_bar)
        self.mpm.gradient_bar[p] += isotropic.strain_adjoint(
            f, strain, log_j_bar + bar[0],
            b_bar + bar[1] * identity3(), b_inverse_bar + bar[2] * identity3(),
        )  # fmt: skip

    @ti.func
    def flow_particle_adjoint(self, t: ti.i32, s: ti.i32, p: ti.i32):
        """``gradient_bar`` -> ``trial_bar``."""
        trial, f = self.mpm.trial_gradient[s, p], self.mpm.deformation_gradient[s, p]
        strain = isotropic.isochoric_strain(trial)
        before = isotropic.invariants(strain)
        cell, inside, slope = self.locate(self.features(before, self.strains[1]))
        flow = self.sample(self.flows, ti.Vector.zero(self.mpm.real, 2), cell, inside)
        share = self.share(flow)
        share_bar, trial_bar, log_j_bar, b_bar, b_inverse_bar = isotropic.flow_adjoint(
            trial, strain, share, f, self.mpm.gradient_bar[p]
        )
        flow_bar = share_bar * (1.0 - share)
        feature_bar = self.sample_adjoint(self.flows, self.flows_bar, t, cell, inside, slope, flow_bar)
        bar, strain_bar = self.features_adjoint(before, self.strains[1], feature_bar)
        self.mpm.trial_bar[p] = trial_bar + isotropic.strain_adjoint(
            trial, strain, log_j_bar + bar[0],
            b_bar + bar[1] * identity3(), b_inverse_bar + bar[2] * identity3(),
        )  # fmt: skip
        self.flow_strain_bar[p] += strain_bar

    @ti.kernel
    def backward(self, s: ti.i32, count: ti.i32):
        """``gradient_bar`` and ``stress_bar`` -> ``trial_bar``; adjoints of the tables are added up."""
        if ti.static(self.mpm.gpu):
            for p in range(count):
                self.stress_particle_adjoint(0, s, p)
                self.flow_particle_adjoint(0, s, p)
        else:
            ti.loop_config(block_dim=1)
            for t in range(self.mpm.chunks):
                # Two loops: what a particle computes is one long chain, and a core works at several short ones at once.
                for p in range(t * count // self.mpm.chunks, (t + 1) * count // self.mpm.chunks):
                    self.stress_particle_adjoint(t, s, p)
                for p in range(t * count // self.mpm.chunks, (t + 1) * count // self.mpm.chunks):
                    self.flow_particle_adjoint(t, s, p)
