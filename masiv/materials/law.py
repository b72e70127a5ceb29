"""The interface of every constitutive law."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from masiv.files import write_safetensors

if TYPE_CHECKING:
    from masiv.kernels.mpm import MpmKernels
    from masiv.kernels.substep import SubstepKernels

L = TypeVar("L", bound="Law")
MAX_KNOWN = 16
"""Tensors that a frozen law remembers: tables for as many substeps, of about 0.1 MB each."""


class BoundLaw(ABC):
    """A law attached to the memory of a simulator. Created by ``Law.bind`` for one rollout."""

    @abstractmethod
    def forward(self, s: int, count: int) -> None:
        """Trial gradient at substep s -> elastic deformation gradient and Kirchhoff stress at s."""

    def p2g(self, mpm: MpmKernels, s: int, count: int, nodes: int) -> None:
        """``forward``, then the transfer to the grid; a law that can do both in one pass over the particles does."""
        self.forward(s, count)
        mpm.p2g(s, count, nodes)

    def substeps(self, mpm: MpmKernels, effects: Any, serial: bool) -> SubstepKernels | None:
        """Kernels of whole substeps with this law and ``effects`` (``NoEffects`` or ``ForwardEffects``), ready to be
        launched; None if it has none."""
        return None

    @abstractmethod
    def backward(self, s: int, count: int) -> None:
        """``gradient_bar``, ``stress_bar`` -> ``trial_bar`` at substep s; parameter gradients are summed up."""

    @abstractmethod
    def parameter_gradients(self) -> tuple[torch.Tensor | None, ...]:
        """Gradients with respect to ``Law.parameters()``, in that order, since the binding."""


class SharedBoundLaw(BoundLaw):
    """One whose kernels have a single set of fields for its coefficients, which rollouts use in turn."""

    kernels: Any

    @abstractmethod
    def write(self) -> None:
        """Fill the fields; sums of gradients start at zero."""

    def _own(self) -> None:
        if self.kernels.owner is not self:  # another rollout used the same fields since
            self.write()
            self.kernels.owner = self

    def forward(self, s: int, count: int) -> None:
        self._own()
        self.kernels.forward(s, count)

    def p2g(self, mpm: MpmKernels, s: int, count: int, nodes: int) -> None:
        from masiv.kernels.forward_effects import no_effects

        whole = self.substeps(mpm, no_effects(mpm), True)
        if whole is None:
            super().p2g(mpm, s, count, nodes)
        else:
            whole.transfer(s, count, nodes)

    def substeps(self, mpm: MpmKernels, effects: Any, serial: bool) -> SubstepKernels | None:
        self._own()
        from masiv.kernels.substep import SubstepKernels

        key = (SubstepKernels, self.kernels, effects, serial)
        return mpm.attached(key, lambda: SubstepKernels(mpm, self.kernels, effects, serial))

    def backward(self, s: int, count: int) -> None:
        self._own()
        self.kernels.backward(s, count)


class Law(torch.nn.Module, ABC):
    """Elastic stress and plastic flow of a material.

    ``project`` and ``stress`` are pointwise and differentiable torch functions: the definition of the law, in any
    dtype. ``bind`` gives the fast equivalent on the fields of a simulator.
    """

    kind: str
    _known: dict[Hashable, torch.Tensor] | None = None

    def frozen(self: L) -> L:
        """A copy whose parameters need no gradient and must not change any more: what it computes from its parameters
        alone (tables, coefficients), it computes once."""
        law = copy.deepcopy(self).requires_grad_(False)
        law._known = {}
        return law

    def once(self, key: Hashable, compute: Callable[[], torch.Tensor]) -> torch.Tensor:
        """``compute()``, remembered under ``key`` by a frozen law."""
        if self._known is None:
            return compute()
        value = self._known.pop(key, None)
        if value is None:
            value = compute()
        self._known[key] = value  # the last, as the one used last
        while len(self._known) > MAX_KNOWN:
            del self._known[next(iter(self._known))]
        return value

    @abstractmethod
    def project(self, trial_gradient: torch.Tensor, dt: float) -> torch.Tensor:
        """Return mapping: trial elastic deformation gradient (N, 3, 3) -> elastic deformation gradient (N, 3, 3)."""

    @abstractmethod
    def stress(self, deformation_gradient: torch.Tensor) -> torch.Tensor:
        """Elastic deformation gradient (N, 3, 3) -> Kirchhoff stress (N, 3, 3) [Pa]."""

    @abstractmethod
    def wave_modulus(self) -> float:
        """P-wave modulus lambda + 2 mu at rest [Pa]: sets the speed of sound, hence the substep."""

    @abstractmethod
    def bind(self, kernels: MpmKernels, count: int, dt: float) -> BoundLaw:
        """Attach to the fields of a simulator with ``count`` live particles and substep dt [s]."""

    @abstractmethod
    def description(self) -> dict[str, Any]:
        """The law in ``twin.yaml``: kind, and parameters with units."""

    def file_metadata(self) -> dict[str, str]:
        """Metadata that a file of this law needs in addition to its weights."""
        return {"kind": self.kind}

    def save(self, path: Path) -> None:
        """Write the weights as safetensors, complete or not at all. ``masiv.materials.load.load_law`` reads them."""
        write_safetensors(path, self.state_dict(), self.file_metadata())
