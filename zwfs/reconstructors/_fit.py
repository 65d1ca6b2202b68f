"""State of a maximum-likelihood fit, how well it explains the frames, and the arithmetic of its fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zwfs._arrays import Kind
from zwfs._information import Inverse
from zwfs._likelihood import Noise
from zwfs._propagator import Propagator, split, square

_NOTHING = 1e-300  # keeps quotients finite
_RIDGE = 1e-6  # of the normal equations at points whose reference waves vanish


@dataclass
class Fit:
    """State of the fits of k frame sets."""

    frames: NDArray[np.floating]  # (k, n_masks, ny', nx'), measured
    psi: NDArray[np.floating]  # (k, 2 n_wavelengths, ny, nx), field in the pupil
    waves: NDArray[np.floating]  # (k, n_masks, 2 n_wavelengths, ny', nx'), its fields on the detector
    light: NDArray[np.floating]  # (k, n_masks, ny', nx'), their intensity
    cost: NDArray[np.floating]  # (k,), twice the negative logarithm of the likelihood and of the prior
    coefficients: NDArray[np.floating] | None = None  # (k, m), of the modes
    phase: NDArray[np.floating] | None = None  # (k, ny, nx), in a band of light: not wrapped
    damping: Any = None  # (k,), relative to the mean of the diagonal of the information
    growth: Any = None  # (k,), of the damping after a step that raises the cost
    n_iterations: Any = None  # (k,)
    converged: Any = None  # (k,)
    n_starts: Any = None  # (k,)
    n_reflections: Any = None  # (k,)
    history: NDArray[np.floating] | None = None  # (k, n_iterations + 1, ny, nx)

    def at(self, which: NDArray) -> Fit:
        """Return the fits of some frame sets, by their places or by flags."""
        return Fit(**{name: array[which] for name, array in self._arrays()})

    def take(self, where: NDArray[np.bool_], trial: Fit, xp: Any) -> None:
        """Replace the arrays by those of a trial fit of the same frame sets, where flags (k,) are True."""
        for name, array in trial._arrays():
            if not xp.all(where):
                flags = xp.reshape(where, (-1, *(1,) * (array.ndim - 1)))
                array = xp.where(flags, array, getattr(self, name))
            setattr(self, name, array)

    def put(self, which: NDArray[np.bool_], part: Fit) -> None:
        """Write the fits of some frame sets to their places."""
        for name, array in part._arrays():
            whole = getattr(self, name)
            whole = Kind.of(whole).xp.asarray(whole, copy=True)
            whole[which] = array
            setattr(self, name, whole)

    @classmethod
    def joined(cls, fits: list[Fit], xp: Any) -> Fit:
        """Return the fits of several batches as those of one."""
        if len(fits) == 1:
            return fits[0]
        return cls(**{name: xp.concat([getattr(fit, name) for fit in fits]) for name, _ in fits[0]._arrays()})

    def _arrays(self) -> list[tuple[str, Any]]:
        return [(name, array) for name, array in vars(self).items() if array is not None]


class Hessian(NamedTuple):
    """Damped information of k frame sets."""

    scale: NDArray  # (k,), mean over the pupil of the information about the phase
    damping: NDArray  # (k, 1, 1), added to the diagonal
    inverse: Inverse | NDArray  # for points; for modes the damped matrices themselves, (k, m, m)


class Misfit(NamedTuple):
    """How well fits of so many unknowns explain frames with some noise."""

    noise: Noise
    n_unknowns: int

    def chi2(self, fit: Fit) -> NDArray[np.floating]:
        """Reduced chi-square, (k,)."""
        xp = Kind.of(fit.light).xp
        if self.noise.photons is None:
            return xp.full_like(fit.cost, np.nan)
        misfit, expected, _ = self.noise.misfit(fit.light, fit.frames)
        freedom = expected - self.n_unknowns
        return xp.where(freedom > 0, misfit, np.nan) / freedom

    def explained(self, fit: Fit) -> NDArray[np.bool_]:
        """Whether the noise explains the misfit, (k,)."""
        return self.noise.explains(fit.light, fit.frames, self.n_unknowns)

    def noise_variance(self, fit: Fit) -> NDArray[np.floating]:
        """Variance by which the inverse of the information is multiplied, (k,): 1 with a number of photons."""
        if self.noise.photons is not None:
            return Kind.of(fit.cost).xp.ones_like(fit.cost)
        return fit.cost / max(self.noise.n_values(fit.frames) - self.n_unknowns, 1)


def linear_field(frames: NDArray, psi: NDArray, model: Propagator) -> NDArray:
    """Field that explains the frames best if the reference waves are those of another field, (k, 2, ny, nx).

    With reference waves r_k the frames I_k = P + 2 Re(conj(r_k) psi) + |r_k|^2 are linear in P = |psi|^2 and psi
    (`eq-linear-field`). Three different masks or more determine both.
    """
    xp, light = model.kind.xp, frames[(..., *model.window)]
    waves = model.reference(psi)
    rows = xp.stack([xp.ones_like(light), 2 * waves[:, :, 0, ...], 2 * waves[:, :, 1, ...]], axis=1)
    rows = xp.permute_dims(rows, (0, 3, 4, 1, 2))  # (k, ny, nx, 3, n_masks)
    excess = xp.permute_dims(light - square(waves), (0, 2, 3, 1))[..., np.newaxis]
    normal = rows @ xp.matrix_transpose(rows) + _RIDGE * model.kind.array(np.eye(3))
    solved = xp.linalg.solve(normal, rows @ excess)[..., 0]
    modulus = xp.sqrt(xp.clip(solved[..., 0], 0, None))
    return split(xp.atan2(solved[..., 2], solved[..., 1]), modulus) * model.stop


def reflected(psi: NDArray, reference: NDArray) -> NDArray:
    """Field (k, 2, ny, nx) reflected at the direction of another, r^2 conj(psi) / |r|^2."""
    xp = Kind.of(psi).xp
    real, imag = reference[:, 0, ...], reference[:, 1, ...]
    power = real * real + imag * imag + _NOTHING
    cos, sin = (real * real - imag * imag) / power, 2 * real * imag / power
    return xp.stack(
        [cos * psi[:, 0, ...] + sin * psi[:, 1, ...], sin * psi[:, 0, ...] - cos * psi[:, 1, ...]], axis=1
    )


def turned(psi: NDArray, by: NDArray, xp: Any) -> NDArray:
    """Field (k, 2, ny, nx) turned by about a phase (k, ny, nx), for small ones exactly by it.

    The factor (1 + i x / 2) / (1 - i x / 2) has modulus 1 and the argument 2 arctan(x / 2) = x - x^3 / 12 + ... It
    costs less than exp(i x), and shortens steps that are too long for the quadratic model.
    """
    real, imag = psi[:, 0, ...], psi[:, 1, ...]
    half = 0.5 * by
    sin = by / (1 + half * half)
    cos = 1 - half * sin
    return xp.stack([cos * real - sin * imag, sin * real + cos * imag], axis=1)
