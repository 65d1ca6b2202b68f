"""Model of a camera behind two masks: from maps of light and phase to the counts of each pixel, with derivatives.

The field lives on f x f points per pixel of the camera. A point that is lit in part is two areas: the share s that
is lit, with the field A exp(i phase), and the rest. Its intensity behind a mask with the reference wave r is

    I = s |A exp(i phase) + r|^2 + (1 - s) |r|^2 = |m exp(i phase) + r|^2 + q,

with the mean field m = s A and the light q = s A^2 - m^2 that does not interfere with r. The relay moves the
fields to the plane that is conjugate to the camera, and spreads q, which belongs to waves too steep for the grid.
A Gaussian blur acts on the intensity as a product with its spectrum. A spline takes it to the place that shift,
rotation and magnification give, and a pixel is the mean over its points there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, sparse, special
from scipy.interpolate import BSpline

from zwfs._lowrank import Plane, _axis_functions, _quadrature, _rim, _spectra
from zwfs.masks import Dimple

_TOLERANCE = 1e-6  # of the reference wave
_DEGREE = 5  # of the spline that takes an image to the pixels
_SPLINE = BSpline.basis_element(np.arange(_DEGREE + 2) - (_DEGREE + 1) / 2, extrapolate=False)
_BORDER = 4  # pixels around a frame that are modelled: blurred light that crosses the edge comes back
_LONGEST = 4.0  # displacement of light that the grid does not resolve, over that of the steepest resolved wave
_PLACE = ("row", "column", "rotation", "magnification")
ARM = ("focus", *_PLACE, "flux", "background")
"""Numbers of an optical path: D^2 / lambda for the focus, pixels, pixels, radian and 1 for the place, counts."""
MASKS = ("diameter", "first", "second", "leakage", "blur")
"""Numbers that all images share: lambda/D, radian, radian, fraction of light, pixels rms."""


class Exposure(NamedTuple):
    """Which optical path, which mask (None for a clear frame) and which state of the mirror an image has."""

    arm: int
    mask: int | None
    state: int


class Maps(NamedTuple):
    """Mean field and light that does not interfere, and the phase, on the fine grid of the pupil.

    The points in `cells` may be lit in part: their light is the mean over their cell.
    """

    mean: NDArray[np.float64]
    rest: NDArray[np.float64]
    phase: NDArray[np.float64]
    cells: NDArray[np.bool_] | bool = True


def names_of(n_arms: int) -> list[str]:
    """Names of all numbers in the order of the vector: each arm, then the masks."""
    return [f"arm {arm} {name}" for arm in range(n_arms) for name in ARM] + list(MASKS)


class Camera:
    """Grids of the model and all that does not depend on its parameters.

    The maps have n x n pixels with f = oversampling points along each, and the middle of a frame is theirs but for
    the shift of its arm. The states add the phases `commands`, (n_states, n * f, n * f). The diameter D has
    n_pixels, and that of the dimple is at most `largest` lambda/D.
    """

    def __init__(
        self,
        n: int,
        shape: tuple[int, int],
        n_pixels: float,
        exposures: Sequence[Exposure],
        commands: NDArray,
        oversampling: int,
        largest: float,
    ) -> None:
        self.n, self.shape, self.n_pixels, self.f, self.largest = n, shape, n_pixels, oversampling, largest
        self.exposures = tuple(exposures)
        self.n_arms = 1 + max(one.arm for one in exposures)
        f, inner = oversampling, n * oversampling
        size = max(n, *shape) * f + 2 * _BORDER * f
        while (size - inner) % 2 or fft.next_fast_len(size) != size:
            size += 1
        self.size = size
        self.window = (slice((size - inner) // 2, (size + inner) // 2),) * 2
        self.turns = np.exp(1j * commands)
        axis = (np.arange(size) - (size - 1) / 2) / (n_pixels * f)
        spread = math.sqrt(2) * (inner + size) / (n_pixels * f)
        self._axes, self._spread = (axis[self.window[0]], axis), spread
        self.planes = tuple(_plane(one, largest, spread) for one in self._axes)
        frequency = fft.fftfreq(size) * f  # cycles per pixel
        self.defocus = self.defocus_at(frequency[None, :], frequency[:, None])
        half = fft.rfftfreq(size) * f
        self.squares = frequency[:, None] ** 2 + half**2
        samples = _SPLINE(np.arange(_DEGREE // 2 + 1))
        self.prefilter = 1 / symbol([samples[0], *(2 * samples[1:])], size)

    def defocus_at(self, u: NDArray, v: NDArray) -> NDArray[np.float64]:
        """Phase at frequencies in cycles per pixel that a unit of focus makes."""
        return np.pi * self.n_pixels**2 * (u**2 + v**2)

    def spread_at(self, focus: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Factor of the spectrum of the light that the grid does not resolve, and its derivative by the focus.

        The light of an edge has a power of 1 / nu^2 at nu cycles per pixel, and the relay moves it by
        d = focus D^2 nu across the edge. Only nu > f / 2 is not resolved, so d has the density d_0 / d^2 beyond
        d_0 = d(f / 2). Over all directions of edges the factor at kappa cycles per pixel is,
        with x = 2 pi kappa d_0,

            k(x) = int_{d_0}^inf d_0 / d^2 J_0(2 pi kappa d) dd = J_0(x) - x (1 + J_1(x) - int_0^x J_0),

        and k'(x) = (k - J_0) / x. The density ends at r d_0, so that the factor is
        (k(x) - k(r x) / r) / (1 - 1 / r), which has no kink at focus 0.
        """
        unit = np.pi * np.sqrt(self.squares) * self.f * self.n_pixels**2
        near, far = (_edge_light(x) for x in (unit * abs(focus), _LONGEST * unit * abs(focus)))
        share = 1 - 1 / _LONGEST
        slope = (near[1] - far[1]) / share * unit * math.copysign(1, focus)
        return (near[0] - far[0] / _LONGEST) / share, slope

    def cores(self, diameter: float, focus: float) -> NDArray[np.complex128]:
        """Operators (3, q, r) of the dimple's light: itself, and its derivatives by focus and diameter."""
        dimple = Dimple(diameter, 0.0)
        nodes = [make(dimple, self._spread, _TOLERANCE, 1.0) for make in (_quadrature, _rim)]
        u, v = (np.concatenate(both) for both in zip(*(one[:2] for one in nodes), strict=True))
        disc, rim = (np.zeros(u.size) for _ in range(2))
        disc[: nodes[0][2].size], rim[nodes[0][2].size :] = nodes[0][2], nodes[1][2]
        defocus = self.defocus_at(u / self.n_pixels, v / self.n_pixels)
        factors = np.stack([disc, -1j * defocus * disc, rim])
        factors = factors * np.exp(-1j * focus * defocus) / (self.n_pixels * self.f) ** 2
        source, target = (
            plane.combine.T @ _spectra(((plane.along_y, axis),) * 2, u, v)
            for plane, axis in zip(self.planes, self._axes, strict=True)
        )
        return (target.conj() * factors[:, np.newaxis, :]) @ source.T


def _edge_light(x: NDArray) -> tuple[NDArray, NDArray]:
    """k(x) and k'(x) of `Camera.spread_at`."""
    mean = special.j0(x)
    k = mean - x * (1 + special.j1(x) - special.itj0y0(x)[0])
    return k, np.divide(k - mean, x, out=np.full_like(x, -1.0), where=x > 1e-9)


def symbol(series: Sequence[float], size: int) -> NDArray[np.float64]:
    """Spectrum, (size, size // 2 + 1), of a filter whose spectrum along each axis is a series of cosines."""
    full, half = (
        np.polynomial.chebyshev.chebval(np.cos(2 * np.pi * one), series)
        for one in (fft.fftfreq(size), fft.rfftfreq(size))
    )
    return np.multiply.outer(full, half)


def _plane(axis: NDArray, largest: float, spread: float) -> Plane:
    """Few real functions on a square grid that hold all waves from a disc of the focal plane."""
    along = _axis_functions(axis, largest / 2, _TOLERANCE)
    u, v, _ = _quadrature(Dimple(largest, 0.0), spread, _TOLERANCE)
    waves = _spectra(((along, axis),) * 2, u, v)
    functions, strength, _ = np.linalg.svd(np.concatenate([waves.real, waves.imag], 1), full_matrices=False)
    return Plane(along, along, functions[:, strength > _TOLERANCE * strength[0]])


class Coefficients(NamedTuple):
    """The numbers c_1 and c_2 of the two masks, (2,) each, and their derivatives by the masks' parameters."""

    first: NDArray[np.complex128]
    second: NDArray[np.float64]
    first_slope: NDArray[np.complex128]  # (2, n_masks)
    second_slope: NDArray[np.float64]


def coefficients(masks: dict[str, float]) -> Coefficients:
    """What the masks do to the light of the dimple: c_1 (amplitude) and c_2 (intensity).

    A share q_j of the light carries psi + s_j b, with s_j = exp(i theta_j) - 1: 1 - leakage of this mask, and
    leakage of the other one. So c_1 = sum q_j s_j and c_2 = sum q_j |s_j|^2.
    """
    turn = np.exp(1j * np.array([masks["first"], masks["second"]]))
    strength, leakage = turn - 1, masks["leakage"]
    shares = np.array([[1 - leakage, leakage], [leakage, 1 - leakage]])
    power = np.abs(strength) ** 2
    slope: Any = np.zeros((2, len(MASKS)), complex)  # of the strengths
    place = MASKS.index
    slope[0, place("first")], slope[1, place("second")] = 1j * turn
    first_slope: Any = shares @ slope
    second_slope: Any = shares @ (2 * (strength.conj()[:, None] * slope).real)
    change = np.array([[-1, 1], [1, -1]])
    first_slope[:, place("leakage")] += change @ strength
    second_slope[:, place("leakage")] += change @ power
    return Coefficients(shares @ strength, shares @ power, first_slope, second_slope)


class _Spline:
    """Spline through the fine grid, at the pixels of an image that is moved, turned and magnified."""

    def __init__(self, camera: Camera, place: Sequence[float]) -> None:
        row, column, rotation, magnification = place
        self.shape, self.size, f = camera.shape, camera.size, camera.f
        y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in camera.shape), indexing="ij")
        y, x = y.ravel() - row, x.ravel() - column
        cosine, sine = math.cos(rotation) / magnification, math.sin(rotation) / magnification
        across, down = cosine * x + sine * y, cosine * y - sine * x
        # Changes of (down, across), in pixels, with each number of the place.
        self._moves = (
            (-cosine, -sine),
            (sine, -cosine),
            (-across, down),
            (-down / magnification, -across / magnification),
        )
        middle = (camera.size - 1) / 2
        (rows, along_y, slope_y), (columns, along_x, slope_x) = (
            _weights(one * f + middle, camera.size, f) for one in (down, across)
        )
        self._index = (rows[:, :, None] * camera.size + columns[:, None, :]).reshape(len(rows), -1)
        self._starts = np.arange(len(rows) + 1) * self._index.shape[1]
        self._pairs = (along_y, along_x), (f * slope_y, along_x), (along_y, f * slope_x)

    def _of(self, pair: int) -> sparse.csr_array:
        first, second = self._pairs[pair]
        weights = (first[:, :, None] * second[:, None, :]).ravel()
        return sparse.csr_array((weights, self._index.ravel(), self._starts), (self._index.shape[0], self.size**2))

    @cached_property
    def _matrix(self) -> sparse.csr_array:
        return self._of(0)

    @cached_property
    def _gradient(self) -> tuple[sparse.csr_array, sparse.csr_array]:
        return self._of(1), self._of(2)

    def __call__(self, image: NDArray) -> NDArray:
        return (self._matrix @ image.ravel()).reshape(self.shape)

    def adjoint(self, pixels: NDArray) -> NDArray:
        return (self._matrix.T @ pixels.ravel()).reshape(self.size, self.size)

    def slopes(self, image: NDArray) -> NDArray:
        """Derivatives by row, column, rotation and magnification, (4, ny, nx)."""
        down, across = (one @ image.ravel() for one in self._gradient)
        return np.stack([(down * dy + across * dx).reshape(self.shape) for dy, dx in self._moves])


def _weights(places: NDArray, size: int, f: int) -> tuple[NDArray, NDArray, NDArray]:
    """Nodes, weights and slopes, (n, k) each, of the mean over the f points of a pixel in each place; periodic.

    A point stands for the mean over its cell, so that a pixel on the grid is the mean of its cells exactly.
    """
    inner, n = np.arange(f) - (f - 1) / 2, _DEGREE + f  # nodes that a pixel meets
    nodes = np.floor(places - n / 2).astype(int)[:, None] + np.arange(1, n + 1)
    away = (places[:, None] - nodes)[..., None] + inner
    return (
        nodes % size,
        np.nan_to_num(_SPLINE(away)).mean(axis=-1),
        np.nan_to_num(_SPLINE.derivative()(away)).mean(axis=-1),
    )


@dataclass(eq=False)
class _Part:
    """Steps of the model of one image that its derivative needs."""

    field: NDArray[np.complex128]
    light: NDArray[np.complex128]  # of the dimple
    ahead: NDArray[np.complex128]  # half the derivative of the intensity by the field, conjugated
    across: NDArray[np.complex128]  # the same by the light of the dimple
    spectrum: NDArray[np.complex128]  # of the intensity
    blurred: NDArray[np.float64]
    seen: NDArray[np.float64]  # before flux and background


class Linearised:
    """Images at one point, their derivatives by the maps (`apply`, `adjoint`) and the parameters (`slopes`)."""

    def __init__(self, camera: Camera, maps: Maps, values: NDArray) -> None:
        self.camera, self.maps = camera, maps
        split = values[: -len(MASKS)].reshape(camera.n_arms, len(ARM))
        self.arms = [dict(zip(ARM, row, strict=True)) for row in split.tolist()]
        self.masks = dict(zip(MASKS, values[-len(MASKS) :].tolist(), strict=True))
        self._coefficients = coefficients(self.masks)
        self._transfer = [np.exp(-1j * arm["focus"] * camera.defocus) for arm in self.arms]
        self._spread = [camera.spread_at(arm["focus"]) for arm in self.arms]
        self._rest = self._spectrum_of(maps.rest)
        self._blur = camera.prefilter * np.exp(-2 * (np.pi * self.masks["blur"]) ** 2 * camera.squares)
        self._splines = [_Spline(camera, [arm[name] for name in _PLACE]) for arm in self.arms]
        masked = {one.arm for one in camera.exposures if one.mask is not None}
        self._cores = {arm: camera.cores(self.masks["diameter"], self.arms[arm]["focus"]) for arm in masked}
        cells = np.zeros((camera.size,) * 2, bool)
        cells[camera.window] = maps.cells
        self._smooth = ~ndimage.binary_dilation(cells) / 24
        self._wave = np.exp(1j * maps.phase)
        self._states = [self._source(maps.mean * self._wave * turn) for turn in camera.turns]
        self._parts = [self._part(one) for one in camera.exposures]
        self.images = [
            self.arms[one.arm]["flux"] * part.seen + self.arms[one.arm]["background"]
            for one, part in zip(camera.exposures, self._parts, strict=True)
        ]

    def _source(self, field: NDArray) -> tuple[NDArray, NDArray]:
        """Spectrum of a field on the whole grid, and its coefficients for the light of the dimple."""
        whole = np.zeros((self.camera.size,) * 2, complex)
        whole[self.camera.window] = field
        return fft.fft2(whole), self.camera.planes[0].project(field)

    def _part(self, one: Exposure) -> _Part:
        spectrum, inputs = self._states[one.state]
        field = fft.ifft2(self._transfer[one.arm] * spectrum)
        light = across = np.zeros(0, complex)
        ahead, intensity = field, field.real**2 + field.imag**2
        if one.mask is not None:
            light = self.camera.planes[1].expand(self._cores[one.arm][0] @ inputs)
            first, second = self._coefficients.first[one.mask], self._coefficients.second[one.mask]
            ahead = field + first * light
            across = np.conj(first) * field + second * light
            intensity = (field.conj() * ahead + light.conj() * across).real
        spectrum = fft.rfft2(self._cells(intensity)) + self._spread[one.arm][0] * self._rest
        blurred = fft.irfft2(self._blur * spectrum, s=intensity.shape)
        return _Part(field, light, ahead, across, spectrum, blurred, self._splines[one.arm](blurred))

    def _spectrum_of(self, light: NDArray) -> NDArray[np.complex128]:
        """Spectrum of a map of light on the whole grid."""
        whole = np.zeros((self.camera.size,) * 2)
        whole[self.camera.window] = light
        return fft.rfft2(whole)

    def _cells(self, intensity: NDArray) -> NDArray[np.float64]:
        """Means over the cells of the points.

        A point that may be lit in part stands for its cell. At others the intensity is the value in the middle,
        and the mean over the cell is larger by 1/24 of the second differences.
        """
        return intensity + self._smooth * _differences(intensity)

    def _on_camera(self, one: Exposure, spectrum: NDArray) -> NDArray[np.float64]:
        """Change of an image with that of the spectrum of its intensity."""
        blurred = fft.irfft2(self._blur * spectrum, s=(self.camera.size,) * 2)
        return self.arms[one.arm]["flux"] * self._splines[one.arm](blurred)

    def _change(
        self, index: int, field: NDArray, inputs: NDArray, core: int, rest: NDArray | float
    ) -> NDArray[np.float64]:
        """Change of an image with the field, the light of the dimple, and the spectrum of what is not resolved.

        The operator number `core` of `Camera.cores` gives the light of the dimple from `inputs`.
        """
        one, part = self.camera.exposures[index], self._parts[index]
        intensity = _twice(part.ahead, field)
        if one.mask is not None:
            intensity += _twice(part.across, self.camera.planes[1].expand(self._cores[one.arm][core] @ inputs))
        return self._on_camera(one, fft.rfft2(self._cells(intensity)) + rest)

    def apply(self, mean: NDArray, rest: NDArray, phase: NDArray) -> list[NDArray[np.float64]]:
        """Change of the images with a change of the maps."""
        change = (mean + 1j * self.maps.mean * phase) * self._wave
        states = [self._source(change * turn) for turn in self.camera.turns]
        unresolved = self._spectrum_of(rest)
        changes = []
        for index, one in enumerate(self.camera.exposures):
            spectrum, inputs = states[one.state]
            field = fft.ifft2(self._transfer[one.arm] * spectrum)
            changes.append(self._change(index, field, inputs, 0, self._spread[one.arm][0] * unresolved))
        return changes

    def adjoint(self, pixels: Sequence[NDArray]) -> Maps:
        """Adjoint of `apply`."""
        camera = self.camera
        spectra = [np.zeros((camera.size,) * 2, complex) for _ in self._states]
        inputs = [np.zeros(source[1].shape, complex) for source in self._states]
        seen = [np.zeros(self._blur.shape, complex) for _ in self.arms]
        for one, part, weight in zip(camera.exposures, self._parts, pixels, strict=True):
            back = self._splines[one.arm].adjoint(self.arms[one.arm]["flux"] * weight)
            spectrum = self._blur * fft.rfft2(back)
            seen[one.arm] += spectrum
            gain = fft.irfft2(spectrum, s=back.shape)
            gain += _differences(self._smooth * gain)
            gain *= 2
            spectra[one.state] += self._transfer[one.arm].conj() * fft.fft2(gain * part.ahead)
            if one.mask is not None:
                core = self._cores[one.arm][0].conj().T
                inputs[one.state] += core @ camera.planes[1].project(gain * part.across)
        unresolved = sum(spread * each for (spread, _), each in zip(self._spread, seen, strict=True))
        rest = fft.irfft2(unresolved, s=(camera.size,) * 2)[camera.window]
        total = np.zeros(rest.shape, complex)
        for spectrum, light, turn in zip(spectra, inputs, camera.turns, strict=True):
            total += turn.conj() * (fft.ifft2(spectrum)[camera.window] + camera.planes[0].expand(light))
        total *= self._wave.conj()
        return Maps(total.real, rest, self.maps.mean * total.imag)

    def slopes(self, index: int, wanted: Sequence[str]) -> NDArray[np.float64]:
        """Derivatives of one image by numbers of its arm or of the masks, (k, ny, nx)."""
        camera, one, part = self.camera, self.camera.exposures[index], self._parts[index]
        arm, (source, inputs) = self.arms[one.arm], self._states[one.state]
        zero = np.zeros(camera.shape)
        place = arm["flux"] * self._splines[one.arm].slopes(part.blurred) if set(wanted) & set(_PLACE) else None
        out = []
        for name in wanted:
            if name in _PLACE and place is not None:
                out.append(place[_PLACE.index(name)])
            elif name == "flux":
                out.append(part.seen)
            elif name == "background":
                out.append(zero + 1)
            elif name == "blur":
                slope = -4 * np.pi**2 * self.masks["blur"] * camera.squares * self._blur
                image = fft.irfft2(slope * part.spectrum, s=part.blurred.shape)
                out.append(arm["flux"] * self._splines[one.arm](image))
            elif name == "focus":
                field = fft.ifft2(-1j * camera.defocus * self._transfer[one.arm] * source)
                out.append(self._change(index, field, inputs, 1, self._spread[one.arm][1] * self._rest))
            elif one.mask is None:
                out.append(zero)
            elif name == "diameter":
                out.append(self._change(index, 0 * part.field, inputs, 2, 0.0))
            else:
                first = self._coefficients.first_slope[one.mask, MASKS.index(name)]
                second = self._coefficients.second_slope[one.mask, MASKS.index(name)]
                change = 2 * (first * part.field.conj() * part.light).real + second * np.abs(part.light) ** 2
                out.append(self._on_camera(one, fft.rfft2(self._cells(change))))
        return np.reshape(out, (len(wanted), *camera.shape))


def _differences(image: NDArray) -> NDArray[np.float64]:
    """Second differences along both axes, periodic."""
    out = -4 * image
    for inner, far in ((out, image), (out.T, image.T)):
        inner[1:] += far[:-1]
        inner[:-1] += far[1:]
        inner[0] += far[-1]
        inner[-1] += far[0]
    return out


def _twice(one: NDArray, other: NDArray) -> NDArray[np.float64]:
    """2 Re(conj(one) other)."""
    return 2 * (one.real * other.real + one.imag * other.imag)
