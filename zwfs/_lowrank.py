"""The reference wave as a product of small real matrices, without a Fourier transform.

A mask differs from 1 on a patch of a few lambda/D only. The operator from the incoming field to the reference wave
is therefore smooth and numerically of very low rank: 28 coefficients describe the wave of a dimple of 1.06
lambda/D to a relative error of 1e-10. `factorise` computes the factors to a tolerance; `Operator` applies them and
their adjoint.

The functions of the factors are products of one-dimensional ones along y and x (Slepian's prolate functions of the
two axes). Projecting a map of N x N pixels costs two thin matrix products, and nothing larger than N times the
number of these functions is stored.

The functions are real. A complex map is therefore two real ones, which stay apart: "split" fields have shape
(..., 2, ny, nx), real part first. The complex calls of a sensor split the coefficients only.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs._arrays import Immutable, Kind, any_array, is_complex, joined, parted, product, read_only
from zwfs.masks import Dimple, Mask, Outline

_NODES = 2048  # of a quadrature handled together: wide detectors and large masks have many
_ROUNDING = 1e-13  # error of a reference wave, relative to the incoming one, that rounding may cause
_ATTRIBUTES = ("diameter", "breaks", "n_samples", "transmission")  # of a mask
_OUTLINED = 64  # nodes around the axis, at least, where an outline is no circle
_MOST_WORK = 5e9  # quadrature nodes times coefficients: about 15 seconds


@dataclass(frozen=True, eq=False)
class Plane(Immutable):
    """Real functions on a grid: products of functions of y and of x, and combinations of these.

    Arrays of NumPy are kept as read-only views.

    Attributes
    ----------
    along_y : array, shape (a, ny)
    along_x : array, shape (b, nx)
    combine : array, shape (a * b, r)
    """

    along_y: NDArray
    along_x: NDArray
    combine: NDArray

    def __post_init__(self) -> None:
        for name in ("along_y", "along_x", "combine"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @cached_property
    def xp(self) -> Any:
        """Namespace of the library that the arrays belong to."""
        return any_array(self.combine)[1]

    @property
    def rank(self) -> int:
        """Number of functions."""
        return self.combine.shape[1]

    def project(self, maps: NDArray) -> NDArray:
        """Inner products with real or complex maps: (..., ny, nx) to (..., r)."""
        if is_complex(maps, self.xp):
            return joined(self.project_complex(maps), -2)
        return self._along_rows(self.along_y @ maps)

    def expand(self, coefficients: NDArray) -> NDArray:
        """Maps of real or complex coefficients: (..., r) to (..., ny, nx)."""
        if is_complex(coefficients, self.xp):
            return self.expand_complex(parted(coefficients, -2, self.xp))
        return self.along_y.T @ self._rows(coefficients)

    def project_complex(self, maps: NDArray) -> NDArray:
        """Real and imaginary parts of inner products with complex maps: (..., ny, nx) to (..., 2, r)."""
        return self._along_rows(parted(product(self.along_y, maps, self.xp), -3, self.xp))

    def expand_complex(self, parts: NDArray) -> NDArray:
        """Complex maps of real and imaginary parts of coefficients: (..., 2, r) to (..., ny, nx)."""
        return product(self.along_y.T, joined(self._rows(parts), -3), self.xp)

    def _along_rows(self, rows: NDArray) -> NDArray:
        pairs = rows @ self.along_x.T
        return self.xp.reshape(pairs, (*rows.shape[:-2], -1)) @ self.combine

    def _rows(self, coefficients: NDArray) -> NDArray:
        shape = (*coefficients.shape[:-1], self.along_y.shape[0], self.along_x.shape[0])
        return self.xp.reshape(coefficients @ self.combine.T, shape) @ self.along_x

    def cut(self, rows: slice, columns: slice) -> Plane:
        """The same functions on a part of the grid."""
        # Copies, also of the whole grid: NumPy rounds a product of an array and itself in another way.
        return Plane(self.along_y[:, rows].copy(), self.along_x[:, columns].copy(), self.combine)

    def to(self, kind: Kind) -> Plane:
        """The same functions in another library, precision or device."""
        return Plane(*(kind.array(array) for array in (self.along_y, self.along_x, self.combine)))

    def products(self, partner: Plane, weight: NDArray) -> NDArray:
        """Weighted inner products of these functions with those of another plane on the same grid, (r, r')."""
        along_y, along_x = (
            (mine[:, np.newaxis] * others).reshape(-1, mine.shape[1])
            for mine, others in ((self.along_y, partner.along_y), (self.along_x, partner.along_x))
        )
        pairs = (along_y @ weight @ along_x.T).reshape(
            len(self.along_y), len(partner.along_y), len(self.along_x), len(partner.along_x)
        )
        pairs = pairs.transpose(0, 2, 1, 3).reshape(len(self.combine), len(partner.combine))
        return self.combine.T @ pairs @ partner.combine


@dataclass(frozen=True, eq=False)
class Factors(Immutable):
    """Low-rank factors of the operator from the pupil to the reference waves (`eq-low-rank`).

    Attributes
    ----------
    pupil, detector : Plane
        Functions on the two planes, of rank r and q.
    core : ndarray of complex, shape (n_masks, q, r) or (n_masks, n_wavelengths, q, r)
        Kept as a read-only view.
    """

    pupil: Plane
    detector: Plane
    core: NDArray[np.complex128]

    def __post_init__(self) -> None:
        object.__setattr__(self, "core", read_only(self.core))


class Operator:
    """The factors as arrays of one kind, and the products that sensors and reconstructors compute with them.

    With several wavelengths a split field has two parts for each of them, real part first, which do not mix.

    Parameters
    ----------
    factors : Factors
    window : (slice, slice)
        Where the grid of the pupil lies on the detector.
    kind : Kind
        Of real numbers.
    """

    def __init__(self, factors: Factors, window: tuple[slice, slice], kind: Kind) -> None:
        self._xp = kind.xp
        self._pupil = factors.pupil.to(kind)
        self._detector = factors.detector.to(kind)
        self._window = factors.detector.cut(*window).to(kind)
        self._core = kind.array(split_core(factors.core))
        self._n_parts = 2 * (factors.core.shape[1] if factors.core.ndim == 4 else 1)

    def split_reference(self, psi: NDArray, *, in_window: bool = False) -> NDArray:
        """Reference waves of split fields on the pupil, (k, 2, ny, nx) to (k, n_masks, 2, ny', nx').

        The primed sizes are those of the detector, or those of the pupil's grid if `in_window`.
        """
        return self.split_expand(self.split_project(psi) @ self._core, in_window=in_window)

    def split_project(self, psi: NDArray) -> NDArray:
        """Coefficients of split fields on the pupil: (k, 2, ny, nx) to (k, 2 r), real parts first."""
        return self._in_a_row(self._pupil.project(psi))

    def split_expand(self, coefficients: NDArray, *, in_window: bool = False) -> NDArray:
        """Split waves of coefficients, (k, n 2 q) to (k, n, 2, ny', nx'); sizes as for `split_reference`."""
        plane = self._window if in_window else self._detector
        return plane.expand(self._by_mask(coefficients, plane))

    def split_adjoint(self, waves: NDArray) -> NDArray:
        """Adjoint of `split_reference` on the whole detector: (k, n_masks, 2, ny', nx') to (k, 2, ny, nx)."""
        coefficients = self._in_a_row(self._detector.project(waves)) @ self._core.T
        return self._pupil.expand(self._by_mask(coefficients, self._pupil)[:, 0, ...])

    def complex_reference(self, psi: NDArray) -> NDArray:
        """`split_reference` of complex fields: (k, ny, nx) to (k, n_masks, ny', nx')."""
        coefficients = self._in_a_row(self._pupil.project_complex(psi)) @ self._core
        return self._detector.expand_complex(self._by_mask(coefficients, self._detector))

    def complex_adjoint(self, waves: NDArray) -> NDArray:
        """`split_adjoint` of complex fields: (k, n_masks, ny', nx') to (k, ny, nx)."""
        coefficients = self._in_a_row(self._detector.project_complex(waves)) @ self._core.T
        return self._pupil.expand_complex(self._by_mask(coefficients, self._pupil)[:, 0, ...])

    def _in_a_row(self, coefficients: NDArray) -> NDArray:
        return self._xp.reshape(coefficients, (coefficients.shape[0], -1))

    def _by_mask(self, coefficients: NDArray, plane: Plane) -> NDArray:
        return self._xp.reshape(coefficients, (coefficients.shape[0], -1, self._n_parts, plane.rank))


def split_core(core: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Cores (n, q, r) as a real matrix that acts from the right: coefficients (k, 2 r) to (k, n 2 q).

    Those of w wavelengths, (n, w, q, r), act on the coefficients of each one apart: (k, w 2 r) to (k, n w 2 q).
    """
    block = np.block([[core.real, -core.imag], [core.imag, core.real]])
    if block.ndim == 4:
        n, w, rows, columns = block.shape
        block = np.einsum("nwij,wv->nwivj", block, np.eye(w)).reshape(n * w * rows, w * columns)
    return np.ascontiguousarray(block.reshape(-1, block.shape[-1]).T)


def factorise(
    masks: Sequence[Mask],
    pupil_axes: tuple[NDArray, NDArray],
    detector_axes: tuple[NDArray, NDArray],
    pixel_area: float,
    tolerance: float,
) -> Factors:
    """Factors of the reference-wave operators of several masks, with functions common to all of them.

    The integral over each patch (`eq-kernel`) is replaced by a quadrature that is exact to well below the
    tolerance; its outcome is truncated where singular values fall below the tolerance times the largest.

    Parameters
    ----------
    masks : sequence of Mask
    pupil_axes, detector_axes : (ndarray, ndarray), D
        Coordinates y of the rows and x of the columns.
    pixel_area : float, D^2
    tolerance : float

    Returns
    -------
    Factors

    Warns
    -----
    UserWarning
        If the quadrature of a transmission that varies over the mask misses the tolerance.
    """
    reach = math.hypot(*(np.ptp(np.concatenate(pair)) for pair in zip(pupil_axes, detector_axes, strict=True)))
    for index, mask in enumerate(masks):
        _check_mask(index, mask, pixel_area**-0.5, (*pupil_axes, *detector_axes), reach)
    radius = max(mask.diameter for mask in masks) / 2

    def along(axes: tuple[NDArray, NDArray]) -> tuple[tuple[NDArray, NDArray], ...]:
        return tuple((_axis_functions(axis, radius, tolerance), axis) for axis in axes)

    from_pupil = along(pupil_axes)
    same = all(map(np.array_equal, pupil_axes, detector_axes))
    to_detector = from_pupil if same else along(detector_axes)

    @cache
    def disc(diameter: float) -> NDArray[np.float64]:
        """Core of a dimple that adds 1 to the transmission: half of the nodes, as opposite ones are conjugate."""
        u, v, weights = _quadrature(Dimple(diameter, 0.0), reach, tolerance)
        half = np.flatnonzero(np.cos(1) * u + np.sin(1) * v > 0)  # 1 rad from u: no node lies on the border
        total: Any = 0
        for part in (half[first : first + _NODES] for first in range(0, half.size, _NODES)):
            spectra = _spectra(from_pupil, u[part], v[part])
            onto = spectra if same else _spectra(to_detector, u[part], v[part])
            strength = 2 * pixel_area * weights[part]
            total = total + (onto.real * strength) @ spectra.real.T + (onto.imag * strength) @ spectra.imag.T
        return total

    def core_of(index: int, refinement: float = 1.0) -> NDArray[np.complex128]:
        if _is_uniform(masks[index]):
            change = _transmission(index, masks[index], np.zeros(1), np.zeros(1)) - 1
            return change * disc(masks[index].diameter)
        u, v, weights = _quadrature(masks[index], reach, tolerance, refinement)
        change = pixel_area * weights * (_transmission(index, masks[index], u, v) - 1)
        total: Any = 0
        for part in (slice(first, first + _NODES) for first in range(0, u.size, _NODES)):
            spectra = _spectra(from_pupil, u[part], v[part])
            onto = spectra if same else _spectra(to_detector, u[part], v[part])
            total = total + onto.conj() * change[part] @ spectra.T
        return total

    core = np.array([core_of(index) for index in range(len(masks))])
    varied = [index for index, mask in enumerate(masks) if not _is_uniform(mask)]
    if varied:  # the nodes are enough for a uniform mask
        strongest = max(float(np.linalg.norm(response, 2)) for response in core)
        for index in varied:
            error = float(np.linalg.norm(core_of(index, 1.5) - core[index], 2))
            if error > max(tolerance * strongest, _ROUNDING):
                _warn_of_quadrature(index, masks[index], error / strongest, tolerance)
    combine_out, core, combine_in = _compress(core, tolerance)
    pupil, detector = (
        Plane(along_y, along_x, combine)
        for ((along_y, _), (along_x, _)), combine in ((from_pupil, combine_in), (to_detector, combine_out))
    )
    return Factors(pupil, detector, core)


def _check_mask(index: int, mask: Mask, n_pixels: float, axes: Sequence[NDArray], reach: float) -> None:
    """Require the attributes of a mask, and a width for which the factors are right and small."""
    if isinstance(mask, type) or not all(hasattr(mask, name) for name in _ATTRIBUTES):
        raise TypeError(
            f"masks[{index}] is {_check.shown(mask)}, a {type(mask).__name__}: expected a Dimple or a Patch"
        )
    name = f"masks[{index}]"
    diameter = _check.number(f"{name}.diameter", mask.diameter, 0, open_low=True)
    breaks = _check.breaks(f"{name}.breaks", mask.breaks, diameter)
    n_samples = _check.integer(f"{name}.n_samples", mask.n_samples, 0)
    if diameter > n_pixels * (1 + 1e-12):
        raise ValueError(
            f"{name} is {diameter:g} lambda/D wide: expected at most {n_pixels:g}, the number of pixels across D; "
            "the focal field of a sampled pupil repeats beyond"
        )
    coefficients = math.prod(min(diameter * np.ptp(axis) + 8, axis.size) for axis in axes)
    most, needed = math.sqrt(2 * _MOST_WORK / coefficients / (len(breaks) + 1)), np.pi * diameter * reach + 20
    if needed <= most < n_samples:
        raise ValueError(
            f"{name}.n_samples = {n_samples}: expected at most {int(most)} for a mask {diameter:g} lambda/D wide, "
            f"with {len(breaks)} breaks"
        )
    if needed > most:
        raise ValueError(
            f"{name} is {diameter:g} lambda/D wide, with {len(breaks)} breaks, on a detector that is "
            f"{np.ptp(axes[-1]):.3g} D wide: expected a smaller mask or a smaller extent, for which the factors "
            "are small"
        )


def _is_uniform(mask: Mask) -> bool:
    """Whether the transmission is the same everywhere on a mask: a dimple, but no subclass with its own."""
    return getattr(type(mask), "transmission", None) is Dimple.transmission


def _transmission(index: int, mask: Mask, u: NDArray, v: NDArray) -> NDArray[np.complex128]:
    name = f"transmission of masks[{index}]"
    values = _check.complex_array(name, mask.transmission(u, v))
    if values.shape != u.shape:
        raise ValueError(f"{name} has shape {values.shape}: expected {u.shape}, as u and v")
    _check.finite(name, values)
    return values


def _warn_of_quadrature(index: int, mask: Mask, error: float, tolerance: float) -> None:
    warnings.warn(
        f"masks[{index}]: the reference wave has an error of about {error:.1g}, relative to the strongest "
        f"response, which exceeds the tolerance of {tolerance:g}; the transmission varies too fast for the nodes "
        "of its quadrature: name circles and outlines at which it jumps in `breaks`, or raise `n_samples` (now "
        f"{mask.n_samples})",
        UserWarning,
        stacklevel=6,  # the caller of the sensor, beyond the end of its constructor
    )


def _axis_functions(axis: NDArray, radius: float, tolerance: float) -> NDArray:
    """Orthonormal functions on an axis that hold all waves of frequencies up to `radius`: (a, n)."""
    n_nodes = _bandwidth(2 * np.pi * radius * np.ptp(axis), tolerance)
    unit, weights = gauss_legendre(n_nodes)
    angle = np.pi * radius * np.outer(unit + 1, axis)
    waves = np.sqrt(weights)[:, np.newaxis] * np.stack([np.cos(angle), np.sin(angle)])
    _, strength, functions = np.linalg.svd(waves.reshape(-1, axis.size), full_matrices=False)
    return functions[: _rank(strength, max(tolerance, 1e-16))]


@cache
def gauss_legendre(n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes and weights of the Gauss-Legendre quadrature on (-1, 1), (n,) each."""
    unit, weights = np.polynomial.legendre.leggauss(n)
    return read_only(unit), read_only(weights)


def _quadrature(
    mask: Mask, reach: float, tolerance: float, refinement: float = 1.0
) -> tuple[NDArray, NDArray, NDArray]:
    """Nodes u, v and weights on the patch: Gauss-Legendre along the radius, equispaced around the axis."""
    asked = max(mask.n_samples + mask.n_samples % 2, _OUTLINED * any(map(callable, mask.breaks)))
    n_angles = max(_bandwidth(np.pi * mask.diameter * reach, tolerance), asked)
    n_angles = 2 * round(n_angles * refinement / 2)
    unit, unit_weights = (column[:, np.newaxis] for column in gauss_legendre(n_angles // 2))
    angle = 2 * np.pi * np.arange(n_angles) / n_angles
    edges = _radii(mask, angle)[:, np.newaxis]
    low, high = edges[:-1], edges[1:]
    radius = low + (high - low) * (unit + 1) / 2
    ring = radius * ((high - low) / 2 * unit_weights)
    weights = ring * 2 * np.pi / n_angles
    return (radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel(), weights.ravel()


def _radii(mask: Mask, angle: NDArray) -> NDArray[np.float64]:
    """Radii of the centre, the breaks and the rim of a mask at angles: (n,) to (n_breaks + 2, n), in order."""
    widths = [np.zeros(angle.shape)]
    for index, edge in enumerate(mask.breaks):
        widths.append(
            _width(f"breaks[{index}]", edge, angle, mask.diameter) if callable(edge) else edge + widths[0]
        )
    return np.sort([*widths, mask.diameter + widths[0]], axis=0) / 2


def _width(name: str, outline: Outline, angle: NDArray, diameter: float) -> NDArray[np.float64]:
    """Checked diameters of an outline at angles; an outline that touches the rim may round beyond it."""
    widths = _check.real_array(f"{name}(angle)", outline(angle.copy()))
    if widths.shape not in ((), angle.shape):
        raise ValueError(f"{name}(angle) has shape {widths.shape}: expected {angle.shape}, as angle")
    _check.finite(f"{name}(angle)", widths)
    low, high = widths.min(), widths.max()
    if low < 0 or high > diameter * (1 + 1e-12):
        raise ValueError(
            f"{name}(angle) reaches from {low:.6g} to {high:.6g}: expected diameters in [0, {diameter:g}]"
        )
    return np.minimum(np.broadcast_to(widths, angle.shape), diameter)


def _rim(mask: Mask, reach: float, tolerance: float, refinement: float = 1.0) -> tuple[NDArray, NDArray, NDArray]:
    """Equispaced nodes u, v on the rim of a patch; the sum is the derivative of its integral by the diameter."""
    radius = mask.diameter / 2
    n_angles = _bandwidth(2 * np.pi * radius * reach, tolerance)
    angle = 2 * np.pi * np.arange(n_angles) / n_angles
    return radius * np.cos(angle), radius * np.sin(angle), np.full(n_angles, np.pi * radius / n_angles)


def _bandwidth(argument: float, tolerance: float) -> int:
    """Even order from which on the Bessel functions J_n(`argument`) stay far below the tolerance."""
    target = math.log(max(1e-3 * tolerance, 1e-18))
    n = 8
    while argument > 1e-300 and n * math.log(argument / 2) - math.lgamma(n + 1) > target:
        n += 2
    return n


def _spectra(functions: tuple[tuple[NDArray, NDArray], ...], u: NDArray, v: NDArray) -> NDArray:
    """Fourier sums of all products of two axis functions at the nodes (u, v): (a * b, n_nodes)."""
    (along_y, y), (along_x, x) = functions
    spectrum_y = along_y @ np.exp(-2j * np.pi * np.outer(y, v))
    spectrum_x = along_x @ np.exp(-2j * np.pi * np.outer(x, u))
    return (spectrum_y[:, np.newaxis] * spectrum_x).reshape(-1, u.size)


def _compress(core: NDArray[np.complex128], tolerance: float) -> tuple[NDArray, NDArray, NDArray]:
    """Split (n_masks, q0, r0) into real left (q0, q), core (n_masks, q, r) and real right (r0, r).

    The bases are common to all masks and real, so they are those of the real and imaginary parts of all cores. The
    columns of these matrices, next to each other, span the outputs: their left singular vectors are the basis of
    the outputs. The rows of what remains in that basis, below each other, span the inputs. Singular values below
    the tolerance are dropped each time.
    """
    parts = np.concatenate([core.real, core.imag])
    outputs, strength, _ = np.linalg.svd(np.concatenate(list(parts), axis=1), full_matrices=False)
    outputs = np.ascontiguousarray(outputs[:, : _rank(strength, tolerance)])
    _, strength, inputs = np.linalg.svd(np.concatenate(list(outputs.T @ parts)), full_matrices=False)
    inputs = inputs[: _rank(strength, tolerance)].T
    return outputs, outputs.T @ core @ inputs, inputs


def _rank(strength: NDArray, tolerance: float) -> int:
    """Number of singular values above the tolerance; 1 at least, for masks that change nothing."""
    return max(1, int(np.count_nonzero(strength > tolerance * strength[0])))
