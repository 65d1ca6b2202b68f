"""Forward model of all images of a recording, its derivative and the adjoint of the derivative.

The model describes every image by one field on the grid of the pupil, amplitude * exp(i phase), which is common to
all images. A `MaskPair` holds the parameters that all images share, an `Arm` those of one optical path, and a
`Picture` the counts of one image. All parameters are numbers of one vector, in the order of `parameters`.

The image of an arm is |P|^2 + 2 Re(c_1 conj(P) B) + c_2 |B|^2. P is the field, Fresnel-propagated to the plane
that is conjugate to the camera, and B is the light of the dimple there. The complex number c_1 and the real number
c_2 contain all of the mask but its diameter (`coefficients`): phase shifts, leakage and unmodulated light. The
frames of one mask thus determine three numbers of it besides the diameter, whatever the number of parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft, sparse

from zwfs import _check
from zwfs._lowrank import _axis_functions, _quadrature, _spectra
from zwfs.masks import Dimple

__all__: list[str] = []  # a part of the package, not for its users

_ALL: Any = None
_TOLERANCE = 1e-6  # of the reference wave


@dataclass(frozen=True)
class Parameter:
    """Parameter of the model: fixed, free, or free with a Gaussian prior around its value.

    Parameters
    ----------
    value : float
        Where the parameter is fixed, or where a fit starts.
    free : bool
    sigma : float
        Standard deviation of the prior of a free parameter; infinite for none.
    low, high : float
        Limits of a fit.

    Raises
    ------
    ValueError
        If the value is outside the limits.

    Examples
    --------
    >>> from zwfs.frames.optics_model import Parameter
    >>> Parameter(1.06).free, Parameter.fitted(1.06, low=0.5).free
    (False, True)
    """

    value: float
    free: bool = False
    sigma: float = math.inf
    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        _check.flag("free", self.free)
        for name in ("sigma", "low", "high"):
            bound = getattr(self, name)
            if not (isinstance(bound, float) and math.isinf(bound)):
                _check.number(name, bound)
        if not self.sigma > 0:
            raise ValueError(f"sigma = {self.sigma}: expected a standard deviation above 0")
        _check.number("value", self.value, self.low, self.high)

    @classmethod
    def fitted(
        cls, value: float, low: float = -math.inf, high: float = math.inf, sigma: float = math.inf
    ) -> Parameter:
        """Free parameter that starts at a value."""
        return cls(value, True, sigma, low, high)


_ZERO, _ONE, _TWO = Parameter(0.0), Parameter(1.0), Parameter(2.0)
_DESIGN = Parameter(1.06), Parameter(math.pi / 2), Parameter(-math.pi / 2)


@dataclass(frozen=True)
class Arm:
    """Parameters of one optical path, from the mask to the camera.

    Parameters
    ----------
    focus : Parameter, D^2 / lambda
        Distance from the pupil to the plane that is conjugate to the camera.
    astigmatism, astigmatism_45 : Parameter, D^2 / lambda
        The same distance for light that is spread along x is larger by `astigmatism`, and along y smaller; the
        second parameter acts along the diagonals.
    row, column : Parameter, pixels
        Shift of the image.
    rotation : Parameter, radian
        Of the image on the camera, from +x towards +y.
    magnification : Parameter
        Size of the image over that of the grid of the pupil.
    flux : Parameter, counts
        Of an amplitude of 1.
    background : Parameter, counts
    halo : Parameter, counts
        Light of the neighbour at the middle of this image, see `Picture.neighbour`.

    Examples
    --------
    >>> from zwfs.frames.optics_model import Arm, Parameter
    >>> arm = Arm(row=Parameter.fitted(0.0, -5.0, 5.0), flux=Parameter(2000.0))
    >>> arm.row.free, arm.flux.free, arm.magnification.value
    (True, False, 1.0)
    """

    focus: Parameter = _ZERO
    astigmatism: Parameter = _ZERO
    astigmatism_45: Parameter = _ZERO
    row: Parameter = _ZERO
    column: Parameter = _ZERO
    rotation: Parameter = _ZERO
    magnification: Parameter = _ONE
    flux: Parameter = _ONE
    background: Parameter = _ZERO
    halo: Parameter = _ZERO


@dataclass(frozen=True)
class MaskPair:
    """Parameters that all images share: those of the two masks, the blur and the shape of the halo.

    Parameters
    ----------
    diameter : Parameter, lambda/D
    first, second : Parameter, radian
        Phase shifts of the two masks.
    leakage : Parameter
        Fraction of the light of each image that passed the other mask. The polarisations do not interfere.
    incoherent : Parameter
        Fraction of the light that no mask has shifted and that does not interfere: a retardance other than half a
        wave does that to unpolarised light.
    in_phase, quadrature : Parameter
        Amplitude of light that no mask has shifted and that interferes, over that of the shifted light. A
        retardance of half a wave plus delta does that to linearly polarised light: tan(delta / 2) in quadrature.
        Both weaken the light of the dimple by the complex factor 1 / (1 + in_phase + i quadrature).
    blur : Parameter, pixels rms
        Gaussian blur of the images.
    halo_slope : Parameter
        The halo of the neighbour falls with its distance to this power.

    Examples
    --------
    >>> from zwfs.frames.optics_model import MaskPair, Parameter
    >>> mask = MaskPair(leakage=Parameter.fitted(0.01, 0.0, 0.5))
    >>> mask.diameter.value, mask.leakage.free
    (1.06, True)
    """

    diameter: Parameter = _DESIGN[0]
    first: Parameter = _DESIGN[1]
    second: Parameter = _DESIGN[2]
    leakage: Parameter = _ZERO
    incoherent: Parameter = _ZERO
    in_phase: Parameter = _ZERO
    quadrature: Parameter = _ZERO
    blur: Parameter = _ZERO
    halo_slope: Parameter = _TWO


class ArmValues(NamedTuple):
    """Values of an `Arm`."""

    focus: float
    astigmatism: float
    astigmatism_45: float
    row: float
    column: float
    rotation: float
    magnification: float
    flux: float
    background: float
    halo: float


class MaskValues(NamedTuple):
    """Values of a `MaskPair`."""

    diameter: float
    first: float
    second: float
    leakage: float
    incoherent: float
    in_phase: float
    quadrature: float
    blur: float
    halo_slope: float


_N_ARM, _N_MASK = len(ArmValues._fields), len(MaskValues._fields)
_N_RELAY = 5  # the first parameters of an arm act on the spectrum of the field
_ROW = ArmValues._fields.index("row")
_ROTATION, _FLUX = ArmValues._fields.index("rotation"), ArmValues._fields.index("flux")
_BLUR = MaskValues._fields.index("blur")


@dataclass(frozen=True, eq=False)
class Picture:
    """Counts of one image, and what is known of it.

    Parameters
    ----------
    counts : array_like, shape (ny, nx)
        Less the dark. Its middle is the middle of the pupil, but for the shift of the arm; ny and nx are even if
        the grid of the pupil has an even number of rows and columns, else odd.
    arm : int
        Number of its `Arm`. Images that differ in the state of the mirror only have the same arm.
    mask : int or None
        0 or 1: which of the masks it stands behind. None for a clear frame.
    sigma : float or array_like, counts rms
        Noise of a pixel.
    good : array_like of bool, shape (ny, nx), optional
        Pixels that count; all of them by default.
    known : array_like, shape of the pupil's grid, radian, optional
        Phase that a known command adds to that of the maps.
    neighbour : (float, float), D, optional
        Distance of the other image along rows and columns. Its halo stands on this image.

    Examples
    --------
    >>> import numpy as np
    >>> from zwfs.frames.optics_model import Picture
    >>> picture = Picture(np.ones((4, 4)), arm=0, mask=1, sigma=0.5, good=np.eye(4) == 0)
    >>> picture.weight[0]
    array([0., 2., 2., 2.])
    """

    counts: NDArray[np.float64]
    arm: int
    mask: int | None = None
    sigma: ArrayLike = 1.0
    good: NDArray[np.bool_] = _ALL
    known: NDArray[np.float64] | None = None
    neighbour: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        counts = _check.real_map("counts", self.counts, 2)
        _check.integer("arm", self.arm, 0)
        if self.mask is not None:
            _check.integer("mask", self.mask, 0, 1)
        sigma = _check.real_array("sigma", self.sigma)
        if sigma.shape not in ((), counts.shape):
            raise ValueError(f"sigma has shape {sigma.shape}: expected a number or {counts.shape}, as counts")
        _check.finite("sigma", sigma)
        if sigma.min() <= 0:
            raise ValueError(f"sigma reaches down to {sigma.min():.6g}: expected more than 0")
        good = np.ones(counts.shape, bool) if self.good is None else self.good
        good = _check.flag_map("good", good, counts.shape, some=True)
        if self.known is not None:
            object.__setattr__(self, "known", _check.real_map("known", self.known, 2))
        if self.neighbour is not None and not np.hypot(*_check.pair("neighbour", self.neighbour, _check.number)):
            raise ValueError("neighbour = (0, 0): expected the distance of another image")
        for name, value in {"counts": counts, "sigma": sigma, "good": good}.items():
            object.__setattr__(self, name, value)

    @cached_property
    def weight(self) -> NDArray[np.float64]:
        """One over sigma, 0 where the picture is not good, (ny, nx)."""
        return self.good / np.asarray(self.sigma)


def parameters(arms: Sequence[Arm], mask: MaskPair) -> list[tuple[str, Parameter]]:
    """Return all parameters with their names, in the order of the vector: each arm, then the masks.

    Examples
    --------
    >>> from zwfs.frames.optics_model import Arm, MaskPair, parameters
    >>> named = parameters([Arm(), Arm()], MaskPair())
    >>> len(named), named[0][0], named[-1][0]
    (29, 'arm 0 focus', 'halo_slope')
    """
    named = [
        (f"arm {index} {field.name}", getattr(arm, field.name))
        for index, arm in enumerate(arms)
        for field in fields(arm)
    ]
    return named + [(field.name, getattr(mask, field.name)) for field in fields(mask)]


class Coefficients(NamedTuple):
    """The numbers c_1 and c_2 of the two masks, (2,) each, and their derivatives by the masks' parameters."""

    first: NDArray[np.complex128]
    second: NDArray[np.float64]
    first_slope: NDArray[np.complex128]  # (2, n_mask)
    second_slope: NDArray[np.float64]


def coefficients(mask: MaskValues) -> Coefficients:
    """Return what the mask does to the light of the dimple: c_1 (amplitude) and c_2 (intensity).

    A share q_j of the light carries psi + s_j b, with s_j = (exp(i theta_j) - 1) / (1 + in_phase + i quadrature):
    (1 - incoherent) (1 - leakage) of this mask, (1 - incoherent) leakage of the other one, and incoherent with
    s = 0. So c_1 = sum q_j s_j and c_2 = sum q_j |s_j|^2.

    Examples
    --------
    >>> from zwfs.frames.optics_model import MaskPair, MaskValues, coefficients, parameters
    >>> mask = MaskValues(*(parameter.value for _, parameter in parameters([], MaskPair())))
    >>> coefficients(mask).first.round(6), coefficients(mask).second.round(6)
    (array([-1.+1.j, -1.-1.j]), array([2., 2.]))
    """
    factor = 1 / (1 + mask.in_phase + 1j * mask.quadrature)
    turn = np.exp(1j * np.array([mask.first, mask.second]))
    strength = (turn - 1) * factor
    own, other = (1 - mask.incoherent) * (1 - mask.leakage), (1 - mask.incoherent) * mask.leakage
    mix = np.array([[own, other], [other, own]])
    power = np.abs(strength) ** 2
    slope = np.zeros((2, _N_MASK), complex)  # of the strengths
    names = MaskValues._fields.index
    slope[0, names("first")], slope[1, names("second")] = 1j * turn * factor
    slope[:, names("in_phase")], slope[:, names("quadrature")] = -strength * factor, -1j * strength * factor
    first_slope, second_slope = mix @ slope, mix @ (2 * (strength.conj()[:, None] * slope).real)
    for name, change in (
        ("leakage", (1 - mask.incoherent) * np.array([[-1, 1], [1, -1]])),
        ("incoherent", -np.array([[1 - mask.leakage, mask.leakage], [mask.leakage, 1 - mask.leakage]])),
    ):
        first_slope[:, names(name)] += change @ strength
        second_slope[:, names(name)] += change @ power
    return Coefficients(mix @ strength, mix @ power, first_slope, second_slope)


class Forward:
    """Images of maps and parameters.

    Parameters
    ----------
    pictures : sequence of Picture
        Their counts do not matter here.
    arms : sequence of Arm
        Of which a rotation or magnification that is free, or not that of the grid, matters here.
    inside : ndarray of bool, shape (n, n)
        Grid of the pupil: where light may come through.
    n_pixels : float, pixels
        Diameter D.
    largest : float, lambda/D
        Largest diameter of the dimple.

    Raises
    ------
    TypeError, ValueError
        If a picture does not fit the grid of the pupil, or has the number of an arm that does not exist.

    Examples
    --------
    >>> import numpy as np
    >>> from zwfs import Dimple, Pupil, ZernikeSensor, zernike_basis
    >>> from zwfs.frames.optics_model import Arm, Forward, MaskPair, Picture, parameters
    >>> pupil = Pupil.circular(16)
    >>> forward = Forward([Picture(np.zeros((24, 24)), arm=0, mask=0)], [Arm()], pupil.inside, 16)
    >>> values = np.array([parameter.value for _, parameter in parameters([Arm()], MaskPair())])
    >>> phase = 0.3 * zernike_basis(pupil, 3)[0]
    >>> (image,) = forward.at(pupil.amplitude * np.exp(1j * phase), values).images
    >>> sensor = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), extent=1.5)
    >>> bool(np.allclose(image, sensor.measure(phase)[0], rtol=0, atol=1e-6))
    True
    """

    def __init__(
        self,
        pictures: Sequence[Picture],
        arms: Sequence[Arm],
        inside: NDArray[np.bool_],
        n_pixels: float,
        largest: float = 2.0,
    ) -> None:
        self.pictures, self.n_arms, self.inside, self.n_pixels = tuple(pictures), len(arms), inside, n_pixels
        self._turned = [_turned(arm) for arm in arms]
        n = inside.shape[-1]
        largest_picture = max(n, *(max(picture.counts.shape) for picture in self.pictures))
        widest = largest_picture + 16  # blurred light that crosses the edge comes back on the other side
        while (widest - n) % 2 or fft.next_fast_len(widest, real=True) != widest:
            widest += 1
        self.size = widest
        inner = slice((widest - n) // 2, (widest + n) // 2)
        # What the relay moves over the edge of so long a grid does not come back to any pixel of a picture.
        self._length = max(n + largest_picture, widest)
        while self._length % 2 == 0 or fft.next_fast_len(self._length) != self._length:
            self._length += 1
        for index, picture in enumerate(self.pictures):
            self._check_picture(index, picture)
        known = {id(picture.known): picture.known for picture in self.pictures}
        self._state = [list(known).index(id(picture.known)) for picture in self.pictures]
        self._known = [1.0 if phase is None else np.exp(1j * phase) for phase in known.values()]
        self._frequency = fft.fftfreq(self._length)
        self._relay = self._polynomials(*np.meshgrid(self._frequency, self._frequency))[:_ROW]
        axis = (np.arange(widest) - (widest - 1) / 2) / n_pixels
        spread = math.sqrt(2) * (len(inside) + widest) / n_pixels
        self.planes = tuple(_Plane(one, largest, spread) for one in (axis[inner], axis))
        self._spread = spread

    def _check_picture(self, index: int, picture: Picture) -> None:
        name, n = f"pictures[{index}]", len(self.inside)
        if picture.arm >= self.n_arms:
            raise ValueError(f"{name} has arm = {picture.arm}: expected the number of one of {self.n_arms} arms")
        if any((length - n) % 2 for length in picture.counts.shape):
            raise ValueError(
                f"{name} has shape {picture.counts.shape} on a pupil of {self.inside.shape}: expected even "
                "differences, so that the pixels stand at the same places"
            )
        if picture.known is not None and picture.known.shape != self.inside.shape:
            raise ValueError(f"known of {name} has shape {picture.known.shape}: expected {self.inside.shape}")

    @property
    def n_values(self) -> int:
        """Length of the vector of parameters."""
        return self.n_arms * _N_ARM + _N_MASK

    def split(self, values: NDArray) -> tuple[list[ArmValues], MaskValues]:
        """Values of the arms and of the masks in a vector of all parameters."""
        arms = [ArmValues(*row) for row in values[:-_N_MASK].reshape(-1, _N_ARM).tolist()]
        return arms, MaskValues(*values[-_N_MASK:].tolist())

    def at(self, field: NDArray[np.complexfloating], values: NDArray) -> Linearised:
        """Images, and their derivative, at a field on the pupil (n, n) and at values of the parameters."""
        return Linearised(self, field, values)

    def _polynomials(self, u: NDArray, v: NDArray) -> NDArray[np.float64]:
        """Phases (5, ...) at frequencies in cycles per pixel that a unit of each parameter of the relay makes."""
        scale = np.pi * self.n_pixels**2
        return np.array(
            [
                scale * (u**2 + v**2),
                scale * (u**2 - v**2),
                2 * scale * u * v,
                2 * np.pi * v,
                2 * np.pi * u,
            ]
        )

    def cores(self, diameter: float, relays: Sequence[NDArray]) -> list[NDArray[np.complex128]]:
        """Operators of the dimple's light through the relays of arms, between coefficients of the two planes.

        In each, (7, q, r), the operator comes first, then its derivatives by the parameters of the relay and by
        the diameter.
        """
        u, v, weights = _quadrature(Dimple(diameter, 0.0), self._spread, _TOLERANCE)
        n_angles = round(math.sqrt(2 * u.size))
        angle = 2 * np.pi * np.arange(n_angles) / n_angles
        disc = np.concatenate([weights, np.zeros(n_angles)])
        rim = np.concatenate([np.zeros(u.size), np.full(n_angles, diameter / 4 * 2 * np.pi / n_angles)])
        u = np.concatenate([u, diameter / 2 * np.cos(angle)])
        v = np.concatenate([v, diameter / 2 * np.sin(angle)])
        polynomials = self._polynomials(u / self.n_pixels, v / self.n_pixels)
        factors = np.concatenate([[disc], -1j * polynomials * disc, [rim]])
        source, target = (plane.spectra(u, v) for plane in self.planes)
        through = (np.exp(-1j * np.tensordot(relay, polynomials, 1)) / self.n_pixels**2 for relay in relays)
        return [(target.conj() * (factors * one)[:, np.newaxis, :]) @ source.T for one in through]

    def spectrum(self, field: NDArray) -> NDArray[np.complex128]:
        """Spectrum of a field that begins at the first row and column, (n, n) to (length, length)."""
        return fft.fft(fft.fft(field, self._length, 1, "ortho"), self._length, 0, "ortho")

    def field(self, spectrum: NDArray, size: int) -> NDArray[np.complex128]:
        """The first rows and columns of the field of a spectrum: the adjoint of `spectrum`."""
        return fft.ifft(fft.ifft(spectrum, axis=0, norm="ortho")[:size], norm="ortho")[:, :size]

    def transfer(self, relay: NDArray) -> tuple[NDArray[np.complex128], list[NDArray[np.complex128]]]:
        """Transfer function of the relay of an arm, (length, length), and its derivatives by row and column."""
        spread = np.exp(-1j * np.tensordot(relay[:_ROW], self._relay, 1))
        rows, columns = (self._shift(distance) for distance in relay[_ROW:])
        pairs = (rows[0], columns[0]), (rows[1], columns[0]), (rows[0], columns[1])
        transfer, *slopes = (spread * np.multiply.outer(*pair) for pair in pairs)
        return transfer, slopes

    def _shift(self, distance: float) -> NDArray[np.complex128]:
        """Transfer function of a shift along one axis, in pixels, and its derivative, (2, length).

        A shift by part of a pixel is a convolution with a sinc. It falls so slowly that its period on a grid of
        finite length matters: here it is cut where it would come back. An odd length keeps its alternating signs.
        """
        places = np.rint(self._frequency * self._length)
        x = places - distance
        sinc = np.sinc(x)
        slope = np.where(np.abs(x) > 1e-6, (sinc - np.cos(np.pi * x)) / np.where(x, x, 1), 0)
        # The field of the pupil begins at the first row and column.
        margin = (self.size - len(self.inside)) // 2
        return fft.fft([sinc, slope]) * np.exp(-2j * np.pi * margin * self._frequency)

    def blur(self, sigma: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Transfer function of a Gaussian that is sampled at the pixels, and its derivative, on half the plane."""
        k = np.arange(-math.ceil(6 * sigma) - 1, math.ceil(6 * sigma) + 2)
        kernel = np.exp(-0.5 * (k / max(sigma, 1e-3)) ** 2)
        slope = kernel * k**2 / max(sigma, 1e-3) ** 3
        waves = np.cos(2 * np.pi * np.outer(fft.fftfreq(self.size), k))
        along = waves @ kernel / kernel.sum()
        change = (waves @ slope - along * slope.sum()) / kernel.sum()
        half = self.size // 2 + 1
        return np.outer(along, along[:half]), np.outer(change, along[:half]) + np.outer(along, change[:half])

    def sampler(self, picture: Picture, arm: ArmValues) -> _Crop | _Spline:
        """The way from the grid of the model to the pixels of a picture."""
        if self._turned[picture.arm]:
            return _Spline(self.size, picture.counts.shape, arm.rotation, arm.magnification)
        return _Crop(self.size, picture.counts.shape)

    def halo(self, picture: Picture, slope: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Halo of the neighbour, 1 at the middle of the picture, and its derivative by the slope."""
        if picture.neighbour is None:
            return (np.zeros(picture.counts.shape),) * 2
        y, x = ((np.arange(n) - (n - 1) / 2) / self.n_pixels for n in picture.counts.shape)
        away = np.hypot(*picture.neighbour)
        distance = np.hypot(*np.meshgrid(y - picture.neighbour[0], x - picture.neighbour[1], indexing="ij"))
        # The neighbour is a disc: its halo does not diverge in its middle.
        ratio = np.log(np.maximum(distance, 0.5) / max(away, 0.5))
        shape = np.exp(-slope * ratio)
        return shape, -ratio * shape


class _Plane:
    """Few real functions on a square grid that hold all waves from a disc of the focal plane."""

    def __init__(self, axis: NDArray, largest: float, spread: float) -> None:
        self._axis = axis
        self._along = _axis_functions(axis, largest / 2, _TOLERANCE)
        u, v, _ = _quadrature(Dimple(largest, 0.0), spread, _TOLERANCE)
        waves = _spectra(((self._along, axis),) * 2, u, v)
        functions, strength, _ = np.linalg.svd(np.concatenate([waves.real, waves.imag], 1), full_matrices=False)
        self._combine = functions[:, strength > _TOLERANCE * strength[0]]

    def project(self, field: NDArray) -> NDArray:
        """Coefficients of a field, (n, n) to (r,)."""
        return (self._along @ field @ self._along.T).ravel() @ self._combine

    def expand(self, coefficients: NDArray) -> NDArray:
        """Field of coefficients: the adjoint of `project`."""
        square = (self._combine @ coefficients).reshape((len(self._along),) * 2)
        return self._along.T @ square @ self._along

    def spectra(self, u: NDArray, v: NDArray) -> NDArray[np.complex128]:
        """Fourier sums of all functions, (r, n_nodes)."""
        return self._combine.T @ _spectra(((self._along, self._axis),) * 2, u, v)


class _Crop:
    """The middle of the grid: the pixels of a picture are those of the grid."""

    def __init__(self, size: int, shape: tuple[int, ...]) -> None:
        self._size = size
        self._middle = tuple(slice((size - n) // 2, (size + n) // 2) for n in shape)

    prefilter: NDArray[np.float64] | float = 1.0

    def __call__(self, image: NDArray) -> NDArray:
        return image[self._middle]

    def adjoint(self, pixels: NDArray) -> NDArray:
        image = np.zeros((self._size, self._size))
        image[self._middle] = pixels
        return image

    def slopes(self, image: NDArray) -> NDArray:
        """Derivatives by rotation and magnification, (2, ny, nx): both are fixed."""
        return np.zeros((2, *self(image).shape))


class _Spline:
    """Cubic spline through the grid, at the pixels of a picture that is turned and magnified."""

    def __init__(self, size: int, shape: tuple[int, ...], rotation: float, magnification: float) -> None:
        self._size, self._shape = size, shape
        y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in shape), indexing="ij")
        cosine, sine = math.cos(rotation) / magnification, math.sin(rotation) / magnification
        across, down = (cosine * x + sine * y).ravel(), (cosine * y - sine * x).ravel()
        self._by_rotation = down, -across  # change of (x, y) with the angle
        self._by_magnification = -across / magnification, -down / magnification
        middle = (size - 1) / 2
        columns, along_x, slope_x = _bspline(across + middle, size)
        rows, along_y, slope_y = _bspline(down + middle, size)
        index = (rows[:, :, None] * size + columns[:, None, :]).reshape(len(rows), -1)
        starts = np.arange(len(rows) + 1) * index.shape[1]

        def matrix(first: NDArray, second: NDArray) -> sparse.csr_array:
            weights = (first[:, :, None] * second[:, None, :]).ravel()
            return sparse.csr_array((weights, index.ravel(), starts), (len(rows), size * size))

        self._matrix = matrix(along_y, along_x)
        self._gradient = matrix(along_y, slope_x), matrix(slope_y, along_x)
        wave = np.cos(2 * np.pi * fft.fftfreq(size))
        self.prefilter = 1 / np.multiply.outer((2 + wave) / 3, ((2 + wave) / 3)[: size // 2 + 1])

    def __call__(self, image: NDArray) -> NDArray:
        return (self._matrix @ image.ravel()).reshape(self._shape)

    def adjoint(self, pixels: NDArray) -> NDArray:
        return (self._matrix.T @ pixels.ravel()).reshape(self._size, self._size)

    def slopes(self, image: NDArray) -> NDArray:
        """Derivatives by rotation and magnification, (2, ny, nx)."""
        right, down = (one @ image.ravel() for one in self._gradient)
        pairs = self._by_rotation, self._by_magnification
        return np.stack([(right * x + down * y).reshape(self._shape) for x, y in pairs])


def _turned(arm: Arm) -> bool:
    """Whether the pixels of an arm may not be those of the grid."""
    still = arm.rotation.value == 0 and arm.magnification.value == 1
    return not still or arm.rotation.free or arm.magnification.free


def _bspline(places: NDArray, size: int) -> tuple[NDArray, NDArray, NDArray]:
    """Nodes, weights and slopes of the four cubic B-splines at each place, (n, 4) each; periodic."""
    first = np.floor(places).astype(int)
    t = (places - first)[:, None]
    weights = np.concatenate([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], 1)
    slopes = np.concatenate([-3 * (1 - t) ** 2, 9 * t**2 - 12 * t, -9 * t**2 + 6 * t + 3, 3 * t**2], 1)
    return (first[:, None] + np.arange(-1, 3)) % size, weights / 6, slopes / 6


class Linearised:
    """Images at one point, their derivatives by the field (`apply`) and the parameters (`slope`).

    `adjoint` is the adjoint of `apply`.

    Attributes
    ----------
    images : list of ndarray, counts
        One for each picture.
    """

    def __init__(self, forward: Forward, field: NDArray, values: NDArray) -> None:
        self._forward = forward
        self._arms, self._mask = forward.split(values)
        self._coefficients = coefficients(self._mask)
        self._blur = forward.blur(self._mask.blur)
        relays = [np.array(arm[:_N_RELAY]) for arm in self._arms]
        self._transfer, self._shifted = zip(*(forward.transfer(relay) for relay in relays), strict=True)
        self._turned_back = [transfer.conj() for transfer in self._transfer]
        masked = sorted({picture.arm for picture in forward.pictures if picture.mask is not None})
        cores = forward.cores(self._mask.diameter, [relays[arm] for arm in masked])
        self._cores = dict(zip(masked, cores, strict=True))
        self._states = [self._source(field * known) for known in forward._known]
        self._parts = [self._image(index) for index in range(len(forward.pictures))]
        self.images = [part.image for part in self._parts]

    def _source(self, field: NDArray) -> tuple[NDArray, NDArray]:
        """Spectrum of a field on the pupil, and its coefficients for the light of the dimple."""
        field = field * self._forward.inside
        return self._forward.spectrum(field), self._forward.planes[0].project(field)

    def _image(self, index: int) -> _Part:
        forward, picture = self._forward, self._forward.pictures[index]
        arm = self._arms[picture.arm]
        spectrum, coefficient = self._states[forward._state[index]]
        field = forward.field(self._transfer[picture.arm] * spectrum, forward.size)
        light = across = np.zeros(0, complex)
        ahead, intensity = field, field.real**2 + field.imag**2
        if picture.mask is not None:
            light = forward.planes[1].expand(self._cores[picture.arm][0] @ coefficient)
            first, second = self._coefficients.first[picture.mask], self._coefficients.second[picture.mask]
            ahead = field + first * light
            across = np.conj(first) * field + second * light
            intensity = (field.conj() * ahead + light.conj() * across).real
        sampler = forward.sampler(picture, arm)
        blurred = fft.irfft2(self._blur[0] * sampler.prefilter * fft.rfft2(intensity), s=intensity.shape)
        halo, halo_slope = forward.halo(picture, self._mask.halo_slope)
        seen = sampler(blurred)
        return _Part(
            image=arm.flux * seen + arm.background + arm.halo * halo,
            seen=seen,
            field=field,
            light=light,
            ahead=ahead,
            across=across,
            intensity=intensity,
            blurred=blurred,
            halo=halo,
            halo_slope=halo_slope,
            sampler=sampler,
        )

    def apply(self, field: NDArray) -> list[NDArray[np.float64]]:
        """Change of the images with a change of the field."""
        forward, changes = self._forward, []
        states = [self._source(field * known) for known in forward._known]
        for index, (picture, part) in enumerate(zip(forward.pictures, self._parts, strict=True)):
            spectrum, coefficient = states[forward._state[index]]
            wave = forward.field(self._transfer[picture.arm] * spectrum, forward.size)
            intensity = _twice(part.ahead, wave)
            if picture.mask is not None:
                light = forward.planes[1].expand(self._cores[picture.arm][0] @ coefficient)
                intensity += _twice(part.across, light)
            changes.append(self._on_camera(picture, part, self._blur[0] * fft.rfft2(intensity)))
        return changes

    def slope(self, index: int, values: NDArray) -> NDArray[np.float64]:
        """Change of one image with a change of the parameters."""
        forward, picture, part = self._forward, self._forward.pictures[index], self._parts[index]
        arm, by_mask = self._arms[picture.arm], values[-_N_MASK:]
        row = values[:-_N_MASK].reshape(-1, _N_ARM)[picture.arm]
        rotation, magnification, flux, background, halo = row[_ROTATION:]
        out = flux * part.seen + background + halo * part.halo + by_mask[-1] * arm.halo * part.halo_slope
        if rotation or magnification:
            out += arm.flux * np.tensordot(row[_ROTATION:_FLUX], part.sampler.slopes(part.blurred), 1)
        if not row[:_N_RELAY].any() and not by_mask[:-1].any():
            return out
        spectrum, coefficient = self._states[forward._state[index]]
        intensity = np.zeros(part.intensity.shape)
        if row[:_N_RELAY].any():
            slope = -1j * np.tensordot(row[:_ROW], forward._relay, 1) * self._transfer[picture.arm]
            for change, by_shift in zip(row[_ROW:_N_RELAY], self._shifted[picture.arm], strict=True):
                slope += change * by_shift
            intensity += _twice(part.ahead, forward.field(slope * spectrum, forward.size))
        if picture.mask is not None:
            steps = np.append(row[:_N_RELAY], by_mask[0])
            light = steps @ (self._cores[picture.arm][1:] @ coefficient)
            first = self._coefficients.first_slope[picture.mask] @ by_mask
            second = self._coefficients.second_slope[picture.mask] @ by_mask
            intensity += _twice(part.across, forward.planes[1].expand(light))
            intensity += 2 * (first * part.field.conj() * part.light).real
            intensity += second * (part.light.real**2 + part.light.imag**2)
        transform = self._blur[0] * fft.rfft2(intensity)
        if by_mask[_BLUR]:
            transform += by_mask[_BLUR] * self._blur[1] * fft.rfft2(part.intensity)
        return out + self._on_camera(picture, part, transform)

    def adjoint(self, pixels: Sequence[NDArray]) -> NDArray[np.complex128]:
        """Adjoint of `apply`, for the inner product Re <a, b> of fields."""
        forward = self._forward
        spectra = [np.zeros(spectrum.shape, complex) for spectrum, _ in self._states]
        inputs = [np.zeros(coefficient.shape, complex) for _, coefficient in self._states]
        for index, (picture, part) in enumerate(zip(forward.pictures, self._parts, strict=True)):
            weight, state = pixels[index], forward._state[index]
            back = part.sampler.prefilter * fft.rfft2(
                2 * self._arms[picture.arm].flux * part.sampler.adjoint(weight)
            )
            gain = fft.irfft2(self._blur[0] * back, s=part.field.shape)
            spectra[state] += forward.spectrum(gain * part.ahead) * self._turned_back[picture.arm]
            if picture.mask is not None:
                inputs[state] += self._cores[picture.arm][0].conj().T @ forward.planes[1].project(
                    gain * part.across
                )
        field = np.zeros(forward.inside.shape, complex)
        for spectrum, light, known in zip(spectra, inputs, forward._known, strict=True):
            one = forward.field(spectrum, len(field)) + forward.planes[0].expand(light)
            field += one * np.conj(known)
        return field * forward.inside

    def _on_camera(self, picture: Picture, part: _Part, transform: NDArray) -> NDArray[np.float64]:
        """Counts of a blurred intensity with a given transform."""
        blurred = fft.irfft2(part.sampler.prefilter * transform, s=part.intensity.shape)
        return self._arms[picture.arm].flux * part.sampler(blurred)


def _twice(one: NDArray, other: NDArray) -> NDArray[np.float64]:
    """2 Re(conj(one) other)."""
    return 2 * (one.real * other.real + one.imag * other.imag)


@dataclass(frozen=True, eq=False)
class _Part:
    """Steps of the model of one picture that its derivative needs."""

    image: NDArray[np.float64]
    seen: NDArray[np.float64]  # before flux and background
    field: NDArray[np.complex128]
    light: NDArray[np.complex128]  # of the dimple
    ahead: NDArray[np.complex128]  # half the derivative of the intensity by the field, conjugated
    across: NDArray[np.complex128]  # the same by the light of the dimple
    intensity: NDArray[np.float64]
    blurred: NDArray[np.float64]
    halo: NDArray[np.float64]
    halo_slope: NDArray[np.float64]
    sampler: _Crop | _Spline
