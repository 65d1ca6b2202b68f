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
from copy import copy
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
MASKS = ("diameter", "first", "second", "leakage", "unmasked", "blur")
"""Numbers that all images share: lambda/D, radian, radian, fractions of light, pixels rms."""


class Exposure(NamedTuple):
    """Which optical path, which mask (None for a clear frame) and which state of the mirror an image has."""

    arm: int
    mask: int | None
    state: int


class _Group(NamedTuple):
    """Images with the same optical path and mask, and their states."""

    arm: int
    mask: int | None
    images: list[int]
    states: list[int]


class Maps(NamedTuple):
    """Mean field and light that does not interfere, and the phase, on the fine grid of the pupil.

    The points in `cells` may be lit in part: their light is the mean over their cell.
    """

    mean: NDArray[np.float64]
    rest: NDArray[np.float64]
    phase: NDArray[np.float64]
    cells: NDArray[np.bool_] | bool = True


def names_of(size: int) -> list[str]:
    """Names of so many numbers in the order of the vector: each arm, then the masks."""
    arms = range((size - len(MASKS)) // len(ARM))
    return [f"arm {arm} {name}" for arm in arms for name in ARM] + list(MASKS)


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
        real: Any = np.float64,
    ) -> None:
        self.n, self.shape, self.n_pixels, self.f, self.largest = n, shape, n_pixels, oversampling, largest
        self.exposures, self.commands, self.real = tuple(exposures), commands, real
        f, inner = oversampling, n * oversampling
        size = max(n, *shape) * f + 2 * _BORDER * f
        while (size - inner) % 2 or fft.next_fast_len(size) != size:
            size += 1
        self.size = size
        self.window = (slice((size - inner) // 2, (size + inner) // 2),) * 2
        self.turns = self.complex(np.exp(1j * commands))
        axis = (np.arange(size) - (size - 1) / 2) / (n_pixels * f)
        spread = math.sqrt(2) * (inner + size) / (n_pixels * f)
        self._axes, self._spread = (axis[self.window[0]], axis), spread
        self.planes = tuple(_plane(axis, largest, spread, real) for axis in self._axes)
        frequency = fft.fftfreq(size) * f  # cycles per pixel
        self.defocus = self.defocus_at(frequency[None, :], frequency[:, None])
        half = fft.rfftfreq(size) * f
        self.squares = frequency[:, None] ** 2 + half**2
        samples = _SPLINE(np.arange(_DEGREE // 2 + 1))
        self.prefilter = 1 / symbol([samples[0], *(2 * samples[1:])], size)

        self.double: Camera | None = None  # of which this camera is `single`
        self._optics: Operators | None = None

    def complex(self, values: NDArray) -> NDArray:
        """Complex numbers in the precision of the camera."""
        return values.astype(np.result_type(self.real, np.complex64))

    @cached_property
    def groups(self) -> list[_Group]:
        """Exposures with the same optical path and mask."""
        kinds = list(dict.fromkeys((exposure.arm, exposure.mask) for exposure in self.exposures))
        numbers = [
            [k for k, exposure in enumerate(self.exposures) if (exposure.arm, exposure.mask) == kind]
            for kind in kinds
        ]
        return [
            _Group(*kind, images, [self.exposures[k].state for k in images])
            for kind, images in zip(kinds, numbers, strict=True)
        ]

    @cached_property
    def single(self) -> Camera:
        """Camera with the same settings in single precision."""
        settings: Any = self.exposures, self.commands, self.f, self.largest, np.float32
        camera = Camera(self.n, self.shape, self.n_pixels, *settings)
        camera.double = self
        return camera

    def optics(self, values: NDArray) -> Operators:
        """Operators with these numbers; those of the last call are kept."""
        if self._optics is None or not np.array_equal(self._optics.values, values):
            self._optics = self.double.optics(values).single if self.double else Operators(self, values)
        return self._optics

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
        u, v = (np.concatenate(both) for both in zip(*(node[:2] for node in nodes), strict=True))
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


def pooled(fine: NDArray, f: int) -> NDArray[np.float64]:
    """Mean over blocks of f x f points, (..., n * f, n * f) to (..., n, n)."""
    n = fine.shape[-1] // f
    return fine.reshape(*fine.shape[:-2], n, f, n, f).mean(axis=(-3, -1)) if f > 1 else fine


def symbol(series: Sequence[float], size: int) -> NDArray[np.float64]:
    """Spectrum, (size, size // 2 + 1), of a filter whose spectrum along each axis is a series of cosines."""
    full, half = (
        np.polynomial.chebyshev.chebval(np.cos(2 * np.pi * frequencies), series)
        for frequencies in (fft.fftfreq(size), fft.rfftfreq(size))
    )
    return np.multiply.outer(full, half)


def _plane(axis: NDArray, largest: float, spread: float, real: Any) -> Plane:
    """Few real functions on a square grid that hold all waves from a disc of the focal plane."""
    along = _axis_functions(axis, largest / 2, _TOLERANCE)
    u, v, _ = _quadrature(Dimple(largest, 0.0), spread, _TOLERANCE)
    waves = _spectra(((along, axis),) * 2, u, v)
    functions, strength, _ = np.linalg.svd(np.concatenate([waves.real, waves.imag], 1), full_matrices=False)
    combine = functions[:, strength > _TOLERANCE * strength[0]]
    return Plane(*(part.astype(real) for part in (along, along, combine)))


class Coefficients(NamedTuple):
    """The numbers c_1 and c_2 of the two masks, (2,) each, and their derivatives by the masks' parameters."""

    first: NDArray[np.complex128]
    second: NDArray[np.float64]
    first_slope: NDArray[np.complex128]  # (2, n_masks)
    second_slope: NDArray[np.float64]


def coefficients(masks: dict[str, float]) -> Coefficients:
    """What the masks do to the light of the dimple: c_1 (amplitude) and c_2 (intensity).

    A share q_j of the light carries psi + s_j b, with s_j = exp(i theta_j) - 1: 1 - leakage of this mask, and
    leakage of the other one. A share u, unmasked, carries psi alone. So c_1 = (1 - u) sum q_j s_j and
    c_2 = (1 - u) sum q_j |s_j|^2.
    """
    turn = np.exp(1j * np.array([masks["first"], masks["second"]]))
    strength, leakage, masked = turn - 1, masks["leakage"], 1 - masks["unmasked"]
    split = np.array([[1 - leakage, leakage], [leakage, 1 - leakage]])
    shares = masked * split
    power = np.abs(strength) ** 2
    slope: Any = np.zeros((2, len(MASKS)), complex)  # of the strengths
    place = MASKS.index
    slope[0, place("first")], slope[1, place("second")] = 1j * turn
    first_slope: Any = shares @ slope
    second_slope: Any = shares @ (2 * (strength.conj()[:, None] * slope).real)
    for name, change in (("leakage", masked * np.array([[-1, 1], [1, -1]])), ("unmasked", -split)):
        first_slope[:, place(name)] += change @ strength
        second_slope[:, place(name)] += change @ power
    return Coefficients(shares @ strength, shares @ power, first_slope, second_slope)


class _Spline:
    """Spline through the fine grid, at the pixels of an image that is moved, turned and magnified."""

    def __init__(self, camera: Camera, place: Sequence[float]) -> None:
        row, column, rotation, magnification = place
        self.shape, self.size, self.real, f = camera.shape, camera.size, camera.real, camera.f
        y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in camera.shape), indexing="ij")
        y, x = y.ravel() - row, x.ravel() - column
        cosine, sine = math.cos(rotation) / magnification, math.sin(rotation) / magnification
        across, down = cosine * x + sine * y, cosine * y - sine * x
        self.places = down, across  # of the pixels, in pixels of the maps from their middle
        # Changes of (down, across), in pixels, with each number of the place.
        self._moves = (
            (-cosine, -sine),
            (sine, -cosine),
            (-across, down),
            (-down / magnification, -across / magnification),
        )
        middle = (camera.size - 1) / 2
        (rows, along_y, slope_y), (columns, along_x, slope_x) = (
            _weights(places * f + middle, camera.size, f) for places in (down, across)
        )
        self._index = (rows[:, :, None] * camera.size + columns[:, None, :]).reshape(len(rows), -1)
        self._starts = np.arange(len(rows) + 1) * self._index.shape[1]
        self._pairs = (along_y, along_x), (f * slope_y, along_x), (along_y, f * slope_x)

    @property
    def single(self) -> _Spline:
        """The same in single precision."""
        out = copy(self)
        out.real, out._matrix = np.float32, self._matrix.astype(np.float32)
        out.__dict__.pop("_gradient", None)
        return out

    def _of(self, pair: int) -> sparse.csr_array:
        first, second = self._pairs[pair]
        weights = (first[:, :, None] * second[:, None, :]).ravel().astype(self.real)
        return sparse.csr_array((weights, self._index.ravel(), self._starts), (self._index.shape[0], self.size**2))

    @cached_property
    def _matrix(self) -> sparse.csr_array:
        return self._of(0)

    @cached_property
    def _gradient(self) -> tuple[sparse.csr_array, sparse.csr_array]:
        return self._of(1), self._of(2)

    def __call__(self, images: NDArray) -> NDArray:
        return _each(self._matrix, images, self.shape)

    def adjoint(self, pixels: NDArray) -> NDArray:
        return _each(self._matrix.T, pixels, (self.size, self.size))

    def slopes(self, image: NDArray) -> NDArray:
        """Derivatives by row, column, rotation and magnification, (4, ny, nx)."""
        down, across = (gradient @ image.ravel() for gradient in self._gradient)
        return np.stack([(down * dy + across * dx).reshape(self.shape) for dy, dx in self._moves])


def _each(matrix: sparse.sparray, images: NDArray, shape: tuple[int, int]) -> NDArray:
    """Product of a matrix with each image of a stack, (..., *shape)."""
    flat = images.reshape(-1, images.shape[-2] * images.shape[-1])
    return np.ascontiguousarray((matrix @ flat.T).T).reshape(*images.shape[:-2], *shape)


def _weights(places: NDArray, size: int, f: int) -> tuple[NDArray, NDArray, NDArray]:
    """Nodes, weights and slopes, (n, k) each, of the mean over the f points of a pixel in each place; periodic.

    A point stands for the mean over its cell, so that a pixel on the grid is the mean of its cells exactly.
    """
    n = _DEGREE + f  # nodes that a pixel meets
    first = np.floor(places - n / 2).astype(int) + 1
    values, slopes = np.zeros((2, len(places), n))
    rows = np.arange(len(places))[:, None]
    for inner in np.arange(f) - (f - 1) / 2:
        start = np.floor(places + inner - (_DEGREE + 1) / 2).astype(int) + 1
        columns = (start - first)[:, None] + np.arange(_DEGREE + 1)
        value, slope = _basis(places + inner - start - (_DEGREE - 1) / 2)
        values[rows, columns] += value / f
        slopes[rows, columns] += slope / f
    return (first[:, None] + np.arange(n)) % size, values, slopes


def _basis(part: NDArray) -> tuple[NDArray, NDArray]:
    """Values and slopes, (n, degree + 1), of the B-splines that are not 0 at a part of a step past a node."""
    values = np.ones((len(part), 1))
    for degree in range(1, _DEGREE + 1):
        lower, steps = values, np.arange(degree + 1)
        before, after = (np.pad(lower, ((0, 0), pad)) for pad in ((1, 0), (0, 1)))
        rising = part[:, None] + degree - steps
        values = (rising * before + (degree + 1 - rising) * after) / degree
    return values, before - after


def named(values: NDArray) -> tuple[list[dict[str, float]], dict[str, float]]:
    """Numbers of each arm, and of the masks, by their names."""
    rows = values[: -len(MASKS)].reshape(-1, len(ARM)).tolist()
    arms = [dict(zip(ARM, row, strict=True)) for row in rows]
    return arms, dict(zip(MASKS, values[-len(MASKS) :].tolist(), strict=True))


class Operators:
    """The part of the model that depends on the numbers, and not on the maps."""

    def __init__(self, camera: Camera, values: NDArray) -> None:
        real, self.values = camera.real, values.copy()
        self.arms, self.masks = named(values)
        self.coefficients = coefficients(self.masks)
        used = {exposure.arm for exposure in camera.exposures}
        self.transfer, self.spread, self.splines, self.cores = ({} for _ in range(4))
        spread = {focus: camera.spread_at(focus) for focus in {self.arms[number]["focus"] for number in used}}
        for number in used:
            arm = self.arms[number]
            self.transfer[number] = camera.complex(np.exp(-1j * arm["focus"] * camera.defocus))
            self.spread[number] = [np.asarray(chirp, real) for chirp in spread[arm["focus"]]]
            self.splines[number] = _Spline(camera, [arm[name] for name in _PLACE])
        for number in {exposure.arm for exposure in camera.exposures if exposure.mask is not None}:
            self.cores[number] = camera.complex(camera.cores(self.masks["diameter"], self.arms[number]["focus"]))
        blur = np.exp(-2 * (np.pi * self.masks["blur"]) ** 2 * camera.squares)
        self.blur = (camera.prefilter * blur).astype(real)

    @cached_property
    def single(self) -> Operators:
        """The same in single precision."""
        out = copy(self)
        out.blur = self.blur.astype(np.float32)
        out.transfer, out.cores = (
            {arm: part.astype(np.complex64) for arm, part in parts.items()}
            for parts in (self.transfer, self.cores)
        )
        out.spread = {arm: [chirp.astype(np.float32) for chirp in pair] for arm, pair in self.spread.items()}
        out.splines = {arm: spline.single for arm, spline in self.splines.items()}
        return out


class _Part(NamedTuple):
    """Intermediate results for images of one group that the derivative needs, (n_images, size, size) each."""

    field: NDArray[np.complex128]
    ahead: NDArray[np.complex128]  # derivative of the intensity by the field
    spectrum: NDArray[np.complex128]  # of the intensity
    blurred: NDArray[np.float64]
    seen: NDArray[np.float64]  # before flux and background
    light: NDArray[np.complex128] | None = None  # of the dimple
    across: NDArray[np.complex128] | None = None  # derivative by the light of the dimple


class Linearised:
    """Images at one point, their derivatives by the maps (`apply`, `adjoint`) and the parameters (`slopes`).

    All images stand in one array, (n_images, ny, nx).
    """

    def __init__(self, camera: Camera, maps: Maps, values: NDArray) -> None:
        self.camera, self.optics = camera, camera.optics(values)
        self.arms, self.masks = self.optics.arms, self.optics.masks
        mean, rest, phase = (values.astype(camera.real) for values in maps[:3])
        self.maps = Maps(mean, rest, phase, maps.cells)
        self._rest = self._spectrum_of(rest)
        cells = np.zeros((camera.size,) * 2, bool)
        cells[camera.window] = maps.cells
        self._smooth = (~ndimage.binary_dilation(cells) / 24).astype(camera.real)
        self._wave = np.exp(1j * phase)
        self._spectra, self._inputs = self._source(mean * self._wave * camera.turns)
        self._parts = [self._part(group) for group in camera.groups]
        self.images = np.empty((len(camera.exposures), *camera.shape), camera.real)
        for group, part in zip(camera.groups, self._parts, strict=True):
            arm = self.arms[group.arm]
            self.images[group.images] = arm["flux"] * part.seen + arm["background"]

    def _source(self, fields: NDArray) -> tuple[NDArray, NDArray]:
        """Spectra of fields on the whole grid, and their coefficients for the light of the dimple."""
        whole = np.zeros((*fields.shape[:-2], self.camera.size, self.camera.size), fields.dtype)
        whole[(..., *self.camera.window)] = fields
        return fft.fft2(whole, overwrite_x=True), self.camera.planes[0].project(fields)

    def _part(self, group: _Group) -> _Part:
        optics = self.optics
        field = fft.ifft2(optics.transfer[group.arm] * self._spectra[group.states], overwrite_x=True)
        light = across = None
        ahead = 2 * field.conj()
        intensity = field.real**2 + field.imag**2
        if group.mask is not None:
            light = self._dimple_light(group, self._inputs[group.states], 0)
            first, second = (numbers[group.mask].item() for numbers in optics.coefficients[:2])
            across = first * ahead + 2 * second * light.conj()
            ahead += 2 * (first * light).conj()
            intensity = (_real(ahead, field) + _real(across, light)) / 2
        spectrum = fft.rfft2(self._cells(intensity)) + optics.spread[group.arm][0] * self._rest
        blurred = fft.irfft2(optics.blur * spectrum, s=intensity.shape[-2:])
        return _Part(field, ahead, spectrum, blurred, optics.splines[group.arm](blurred), light, across)

    def _dimple_light(self, group: _Group, inputs: NDArray, core: int) -> NDArray:
        """Light of the dimple in images, by the operator number `core` of `Camera.cores`."""
        return self.camera.planes[1].expand(inputs @ self.optics.cores[group.arm][core].T)

    def _spectrum_of(self, light: NDArray) -> NDArray[np.complex128]:
        """Spectrum of maps of light on the whole grid."""
        whole = np.zeros((*light.shape[:-2], self.camera.size, self.camera.size), light.dtype)
        whole[(..., *self.camera.window)] = light
        return fft.rfft2(whole)

    def _cells(self, intensity: NDArray) -> NDArray[np.float64]:
        """Means over the cells of the points.

        A point that may be lit in part stands for its cell. At others the intensity is the value in the middle,
        and the mean over the cell is larger by 1/24 of the second differences.
        """
        return intensity + self._smooth * _differences(intensity)

    def _on_camera(self, arm: int, spectrum: NDArray) -> NDArray[np.float64]:
        """Change of images with that of the spectra of their intensities."""
        blurred = fft.irfft2(self.optics.blur * spectrum, s=(self.camera.size,) * 2)
        return self.arms[arm]["flux"] * self.optics.splines[arm](blurred)

    def _change(
        self, group: _Group, part: _Part, field: NDArray, dimple: NDArray | None, rest: NDArray | float
    ) -> NDArray[np.float64]:
        """Change of images with the field, the light of the dimple, and the spectrum of what is not resolved."""
        intensity = _real(part.ahead, field)
        if part.across is not None and dimple is not None:
            intensity = intensity + _real(part.across, dimple)
        return self._on_camera(group.arm, fft.rfft2(self._cells(intensity)) + rest)

    def apply(self, mean: NDArray, rest: NDArray, phase: NDArray, *, dimple: bool = True) -> NDArray[np.float64]:
        """Change of the images with a change of the maps, (..., n, n) to (..., n_images, ny, nx).

        Without `dimple`, the light of the dimple stays as it is.
        """
        camera, optics = self.camera, self.optics
        change = (mean + 1j * (self.maps.mean * phase)).astype(self._wave.dtype) * self._wave
        spectra, inputs = self._source(change[..., None, :, :] * camera.turns)
        unresolved = self._spectrum_of(rest.astype(camera.real))[..., None, :, :]
        out = np.empty((*change.shape[:-2], *self.images.shape), camera.real)
        for group, part in zip(camera.groups, self._parts, strict=True):
            field = fft.ifft2(optics.transfer[group.arm] * spectra[..., group.states, :, :], overwrite_x=True)
            moves = dimple and group.mask is not None
            light = self._dimple_light(group, inputs[..., group.states, :], 0) if moves else None
            unseen = optics.spread[group.arm][0] * unresolved
            out[..., group.images, :, :] = self._change(group, part, field, light, unseen)
        return out

    @property
    def phase_slope(self) -> NDArray:
        """Derivative of the field by the phase."""
        return 1j * self.maps.mean * self._wave

    def of_dimple(self, inputs: NDArray) -> NDArray[np.float64]:
        """Change of the images with the coefficients of the dimple's light, (k, r) to (k, n_images, ny, nx)."""
        out = np.zeros((len(inputs), *self.images.shape), self.camera.real)
        for group, part in zip(self.camera.groups, self._parts, strict=True):
            if part.across is not None:
                light = self._dimple_light(group, inputs[:, None].astype(self._wave.dtype), 0)
                change = self._cells(_real(part.across, light))
                out[:, group.images] = self._on_camera(group.arm, fft.rfft2(change))
        return out

    def adjoint(self, pixels: NDArray) -> Maps:
        """Adjoint of `apply`."""
        camera, optics = self.camera, self.optics
        pixels = np.asarray(pixels, camera.real)
        lead, unresolved = pixels.shape[:-3], np.zeros((), self._rest.dtype)
        spectra, inputs = (np.zeros((*lead, *array.shape), array.dtype) for array in (self._spectra, self._inputs))
        for group, part in zip(camera.groups, self._parts, strict=True):
            arm = group.arm
            back = optics.splines[arm].adjoint(self.arms[arm]["flux"] * pixels[..., group.images, :, :])
            spectrum = optics.blur * fft.rfft2(back)
            unresolved = unresolved + optics.spread[arm][0] * spectrum.sum(axis=-3)
            gain = fft.irfft2(spectrum, s=back.shape[-2:])
            gain += _differences(self._smooth * gain)
            # All fields are conjugated.
            ahead = fft.ifft2(gain * part.ahead, overwrite_x=True)
            spectra[..., group.states, :, :] += optics.transfer[arm] * ahead
            if part.across is not None:
                across = camera.planes[1].project(gain * part.across)
                inputs[..., group.states, :] += across @ optics.cores[arm][0]
        window = (..., *camera.window)
        rest = fft.irfft2(unresolved, s=(camera.size,) * 2)[window]
        fields = fft.fft2(spectra, overwrite_x=True)[window] + camera.planes[0].expand(inputs)
        total = np.sum(camera.turns * fields, axis=-3) * self._wave
        return Maps(total.real, rest, -self.maps.mean * total.imag)

    def unspread(self, weights: NDArray, mean: NDArray, rest: NDArray) -> NDArray[np.float64]:
        """Sum of squares of the weighted changes of the images with the light of each point, if no light spread.

        `mean` and `rest` are the derivatives of the maps by the light.
        """
        camera, out = self.camera, np.zeros(mean.shape)
        for group, part in zip(camera.groups, self._parts, strict=True):
            pixels = (self.arms[group.arm]["flux"] * weights[group.images]) ** 2
            gain = self.optics.splines[group.arm].adjoint(pixels)[(..., *camera.window)]
            field = mean * self._wave * camera.turns[group.states]
            out += np.sum(gain * (_real(part.ahead[(..., *camera.window)], field) + rest) ** 2, axis=0)
        return out

    def slopes(self, index: int, wanted: Sequence[str]) -> NDArray[np.float64]:
        """Derivatives of one image by numbers of its arm or of the masks, (k, ny, nx)."""
        camera, optics, state = self.camera, self.optics, self.camera.exposures[index].state
        group, parts = next(
            pair for pair in zip(camera.groups, self._parts, strict=True) if index in pair[0].images
        )
        own: Any = [values if values is None else values[group.images.index(index)] for values in parts]
        part = _Part(*own)
        flux, spread = self.arms[group.arm]["flux"], optics.spread[group.arm][1]
        zero = np.zeros(camera.shape)
        place = flux * optics.splines[group.arm].slopes(part.blurred) if set(wanted) & set(_PLACE) else None
        out = []
        for name in wanted:
            if name in _PLACE and place is not None:
                out.append(place[_PLACE.index(name)])
            elif name == "flux":
                out.append(part.seen)
            elif name == "background":
                out.append(zero + 1)
            elif name == "blur":
                slope = -4 * np.pi**2 * self.masks["blur"] * camera.squares
                out.append(self._on_camera(group.arm, slope * part.spectrum))
            elif name == "focus":
                field = fft.ifft2(-1j * camera.defocus * optics.transfer[group.arm] * self._spectra[state])
                dimple = None if group.mask is None else self._dimple_light(group, self._inputs[state], 1)
                out.append(self._change(group, part, field, dimple, spread * self._rest))
            elif group.mask is None or part.light is None:
                out.append(zero)
            elif name == "diameter":
                dimple = self._dimple_light(group, self._inputs[state], 2)
                out.append(self._change(group, part, 0 * part.field, dimple, 0.0))
            else:
                first = optics.coefficients.first_slope[group.mask, MASKS.index(name)]
                second = optics.coefficients.second_slope[group.mask, MASKS.index(name)]
                change = 2 * (first * part.field.conj() * part.light).real + second * np.abs(part.light) ** 2
                out.append(self._on_camera(group.arm, fft.rfft2(self._cells(change))))
        return np.reshape(out, (len(wanted), *camera.shape))


def _differences(images: NDArray) -> NDArray[np.float64]:
    """Second differences along both axes, periodic."""
    out = -4 * images
    for inner, far in ((out, images), (out.swapaxes(-1, -2), images.swapaxes(-1, -2))):
        inner[..., 1:, :] += far[..., :-1, :]
        inner[..., :-1, :] += far[..., 1:, :]
        inner[..., 0, :] += far[..., -1, :]
        inner[..., -1, :] += far[..., 0, :]
    return out


def _real(first: NDArray, second: NDArray) -> NDArray[np.float64]:
    """Real part of a product."""
    return (first * second).real
