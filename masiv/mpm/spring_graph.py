r"""Bonds between particles at rest.

Each particle $i$ has springs to its $K$ nearest neighbours, softly weighted by distance, as in Spring-Gaus (Zhong et
al., ECCV 2024). Its elastic energy is

.. math::  V_i \sum_j w_{ij}\, 3 E\, (r_{ij} / l_{ij} - 1)^2, \qquad \sum_j w_{ij} = 1 .

For neighbours in all directions alike this is, for small strain $\varepsilon$, the energy density
$\tfrac{E}{5} ((\operatorname{tr} \varepsilon)^2 + 2\, \varepsilon : \varepsilon)$ of an isotropic solid with Young's
modulus $E$ and Poisson's ratio 1/4, the only one that central springs have (Cauchy). The energy of a bond is that of
its two ends together.

differs from Spring-Gaus: there each particle has a stiffness of its own that is learnt, and weights fall with a
power of the distance that is learnt; here the sum of the weights is fixed, so that E has its meaning for any cloud.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import KDTree

from masiv.errors import InputError

NEIGHBOURS = 32
"""Of a particle (fewer in a smaller body): the first shells of a cubic lattice, 6 + 12 + 8 + 6. Chosen."""
PASSES = 30
"""Of the weights towards isotropy, each of which changes a weight by a factor of two at most."""
RIDGE = 1e-4
"""Keeps the equations of neighbours on few sides solvable; moments are of order 0.1 to 1."""


@dataclass(frozen=True)
class SpringGraph:
    """Bonds in compressed rows, each in the rows of both of its ends.

    offsets (N + 1,), others (E,) int32; lengths (E,) [m] at rest; weights (E,) [1]: w_ij + w_ji; neighbours (N, K): of
    each particle, nearest first.
    """

    offsets: np.ndarray
    others: np.ndarray
    lengths: np.ndarray
    weights: np.ndarray
    neighbours: np.ndarray


def spring_graph(rest: np.ndarray) -> SpringGraph:
    """Bonds of particles with positions ``rest`` (N, 3) [m]. Raises InputError for fewer than 5 particles, and for two
    in one place."""
    rest = np.ascontiguousarray(rest, dtype=np.float64)
    return _known_graph(rest.tobytes())


def isotropic_weights(weights: np.ndarray, bonds: np.ndarray) -> np.ndarray:
    """``weights`` (N, K) changed as little as may be so that a particle is as stiff in one direction as in another: the
    fourth moments of the directions of ``bonds`` (N, K, 3) become those of all directions alike. Where neighbours are
    on few sides (edges, corners) they come as near to it as positive weights do. The sum is 1."""
    n = bonds / np.linalg.norm(bonds, axis=2, keepdims=True)
    powers = np.array(list(itertools.combinations_with_replacement(range(3), 4)))
    moments = n[..., powers].prod(-1)  # (N, K, 15)
    often = np.array([[np.count_nonzero(p == axis) for axis in range(3)] for p in powers])
    wanted = np.where((often == 4).any(1), 1 / 5, np.where((often == 2).sum(1) == 2, 1 / 15, 0.0))
    multiplicity = np.array([math.factorial(4) / math.prod(map(math.factorial, row)) for row in often])
    found = weights
    for _ in range(PASSES):
        normal = np.einsum("nka,nk,nkb->nab", moments, found, moments * multiplicity)
        normal += RIDGE * np.eye(len(powers))
        off = wanted - np.einsum("nka,nk->na", moments, found)
        change = np.einsum("nka,na->nk", moments * multiplicity, np.linalg.solve(normal, off[..., None])[..., 0])
        found = found * np.clip(1 + change, 0.5, 2.0)
    return found / found.sum(1, keepdims=True)


@functools.lru_cache(maxsize=4)
def _known_graph(rest: bytes) -> SpringGraph:
    return _graph(np.frombuffer(rest).reshape(-1, 3))


def _graph(rest: np.ndarray) -> SpringGraph:
    count = len(rest)
    if count < 5:
        raise InputError(f"law springs: a body of {count} particles, give at least 5")
    near = min(NEIGHBOURS, count - 1)
    distances, found = map(np.asarray, KDTree(rest).query(rest, near + 1))
    if (distances[:, 1] == 0).any():
        raise InputError("law springs: two particles are in one place")
    distances, found = distances[:, 1:], found[:, 1:]
    soft = np.exp(-((distances / distances.mean(1, keepdims=True)) ** 2))
    weights = isotropic_weights(soft / soft.sum(1, keepdims=True), rest[found] - rest[:, None])
    own = np.repeat(np.arange(count), near)
    rows, columns = np.concatenate([own, found.ravel()]), np.concatenate([found.ravel(), own])
    bonds = coo_array((np.tile(weights.ravel(), 2), (rows, columns)), shape=(count, count)).tocsr()
    bonds.sum_duplicates()
    rows, columns = np.repeat(np.arange(count), np.diff(bonds.indptr)), bonds.indices
    return SpringGraph(
        offsets=bonds.indptr.astype(np.int32),
        others=columns.astype(np.int32),
        lengths=np.linalg.norm(rest[rows] - rest[columns], axis=1),
        weights=bonds.data,
        neighbours=found,
    )
