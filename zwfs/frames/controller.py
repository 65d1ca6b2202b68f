"""Controllers of a loop: camera counts to commands of a mirror, calibrated by pokes of its actuators.

The frames of a loop are close to those of the flat mirror, and differ from them by a linear function of the
commands. With the dark d, a frame over its own light, x = (c - d) / sum(c - d), does not depend on the star, and

    commands = gain M (x - r),    J = (x_pushed - x_pulled) / 2 poke,    M = inverse of J,

where r is x of the flat mirror. `Controller` is this product: the pixels of the camera need no resampling.
`PhaseController` computes the phase of each frame first, which takes longer and reaches farther.
"""

from __future__ import annotations

import io
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Kind, read_only
from zwfs._system import path_of, write_file
from zwfs.frames._blocks import broken
from zwfs.frames._fits import FIRST_BYTES, fits_content, fits_module
from zwfs.frames._stack import Stack
from zwfs.frames.phases import Flag
from zwfs.reconstructors import MaximumLikelihood

if TYPE_CHECKING:
    from zwfs.frames.calibration import Calibration
    from zwfs.frames.phases import Phases

_UNMOVED = 1.2  # response to a poke, in squares and over its noise, below which it shows nothing
_CONTRARY = 0.8  # mean change of push and pull over half their difference: 1 if one of the two did not move
_ALIKE = 0.05  # difference of two responses over their sizes, in squares
_CLEAR = 4.0  # response over its noise, in squares, from which on two responses can be compared
_SILENT = 1e-6  # response to a poke over that of a typical one, in squares: nothing, where there is no noise
_UNSEEN = 1.05  # singular value over that of noise alone, below which a direction is noise
_STILL = 1e-3  # radian rms of the flat mirror's phase, below which it needs no mode
_DIMMEST = 0.05  # variance of the noise of dark pixels, over the mean
_LOST = 5.0  # standard errors of the light, below which a frame has none
_BINS = 4  # of brightness, for the noise
_FEWEST = 0.8  # of the pixels that the pupil covers, which are good in all frames of the pokes
_METHODS = "linear", "phase-shifted", "likelihood"
_NAMES = (
    "matrix",
    "reference",
    "mask",
    "dark",
    "interaction",
    "noise",
)  # arrays of a file, by the names of its units


def make_controller(
    calibration: Calibration, flat: ArrayLike | str | Path, pushed: ArrayLike | str | Path,
    pulled: ArrayLike | str | Path, *, poke: float = 1.0, rcond: float = 0.05, gain: float = 0.5,
    method: str = "linear", n_iterations: int = 3,
) -> Controller | PhaseController:  # fmt: skip
    """Controller from frames of pokes: see `Calibration.controller`."""
    poke = _check.number("poke", poke, 0, _check.LARGEST, open_low=True)
    rcond = _check.number("rcond", rcond, 0, 1, open_high=True)
    gain = _check.number("gain", gain, 0, 2, open_low=True)
    n_iterations = _check.integer("n_iterations", n_iterations, 1)
    if method not in _METHODS:
        raise ValueError(f"method = {_check.shown(method)}: expected one of {', '.join(_METHODS)}")
    pokes = _Pokes.of(calibration, flat, pushed, pulled)
    signals = _Signals.of(calibration, pokes)
    signals.check()
    if method != "linear":
        return PhaseController(
            calibration, pokes, signals.faintest, poke=poke, rcond=rcond, gain=gain,
            likelihood=method == "likelihood", n_iterations=n_iterations,
        )  # fmt: skip
    interaction = signals.difference.T / poke
    weight, error = signals.weights()
    inverse = Inverse.of(weight[:, np.newaxis] * interaction, rcond, error / poke)
    return Controller(
        gain * inverse.matrix * weight, signals.reference, signals.mask, signals.dark, interaction, signals.noise,
        light=signals.light, gain=gain, n_kept=len(inverse.directions), saturation=calibration.saturation,
    )  # fmt: skip


class Controller:
    """Commands from camera counts by one product, in single precision and without an allocation.

    Make one with `Calibration.controller` or `load`. With s = (counts - dark)[mask],

        commands = matrix @ (s / sum(s) - reference)

    are the commands that the frame shows, times the gain: an integrator subtracts them. Pixels that are bad in one
    frame take the value of the reference.

    Parameters
    ----------
    matrix : array_like, shape (n_commands, n_pixels)
        From the signal of a frame to commands, the gain included.
    reference : array_like, shape (n_pixels,)
        Frame of the flat mirror over its light; its sum is 1.
    mask : array_like of bool, shape (ny, nx) or (2, ny, nx)
        Pixels that count, in the order of the camera's memory.
    dark : array_like, shape (n_pixels,), counts
        Counts without light of these pixels.
    interaction : array_like, shape (n_pixels, n_commands)
        Change of the signal by a unit of each command.
    noise : array_like, shape (n_pixels,)
        Standard error of the signal of one frame of the flat mirror.
    light : float, counts
        Sum of the frame of the flat mirror.
    gain : float
    n_kept : int
        Directions of the commands that are inverted.
    saturation : float, counts
        Pixels that reach it are bad.

    Attributes
    ----------
    flux : float
        Light of the last frame over that of the flat mirror.
    n_bad : int
        Pixels of the last frame that were replaced.
    lost : bool
        Whether the last frame had no light: then the commands are 0.
    """

    def __init__(
        self, matrix: ArrayLike, reference: ArrayLike, mask: ArrayLike, dark: ArrayLike, interaction: ArrayLike,
        noise: ArrayLike, *, light: float, gain: float, n_kept: int, saturation: float = np.inf,
    ) -> None:  # fmt: skip
        whole = _check.plain_array("mask", mask)
        self.mask = read_only(_check.flag_map("mask", whole, whole.shape, some=True).copy())
        if self.mask.ndim not in (2, 3):
            raise ValueError(f"mask has shape {self.mask.shape}: expected (ny, nx) or (2, ny, nx)")
        n_pixels, n_commands = int(np.count_nonzero(self.mask)), len(_check.real_array("matrix", matrix))
        arrays = {
            "matrix": matrix,
            "reference": reference,
            "dark": dark,
            "interaction": interaction,
            "noise": noise,
        }
        shapes = {"matrix": (n_commands, n_pixels), "interaction": (n_pixels, n_commands)}
        for name, values in arrays.items():
            array = _check.real_array(name, values).astype(np.float32, order="C")
            if array.shape != shapes.get(name, (n_pixels,)):
                raise ValueError(f"{name} has shape {array.shape}: expected {shapes.get(name, (n_pixels,))}")
            _check.finite(name, array)
            setattr(self, name, read_only(array))
        self.matrix: NDArray[np.float32]
        self.reference: NDArray[np.float32]
        self.dark: NDArray[np.float32]
        self.interaction: NDArray[np.float32]
        self.noise: NDArray[np.float32]
        self.light = _check.number("light", light, 0, open_low=True)
        self.gain = _check.number("gain", gain, 0, 2, open_low=True)
        self.n_kept = _check.integer("n_kept", n_kept, 1, n_commands)
        self.saturation = float(saturation)
        self.flux, self.n_bad, self.lost = 1.0, 0, False
        self._faintest = max(_LOST * float(np.linalg.norm(self.noise)) * self.light, 1e-30)
        self._pixels = np.flatnonzero(self.mask)
        self._ones = np.ones(n_pixels, np.float32)
        self._signal, self._expected = np.empty((2, n_pixels), np.float32)
        self._raw = np.empty(n_pixels, np.float32)

    def __repr__(self) -> str:
        return (
            f"Controller({len(self._pixels)} pixels to {self.n_commands} commands, {self.n_kept} directions, "
            f"gain={self.gain:g})"
        )

    @property
    def n_commands(self) -> int:
        """Number of commands."""
        return len(self.matrix)

    @property
    def sigma(self) -> NDArray[np.float32]:
        """Standard error of each command that the noise of one frame causes, in the light of the flat mirror."""
        return np.linalg.norm(self.matrix * self.noise, axis=1) / self.gain

    @property
    def expected_residual(self) -> float:
        """Rms of all commands that noise leaves in a loop with the gain and without delay, in units of a command.

        That of one frame, times sqrt(gain / (2 - gain)). It does not include the directions that are left out, nor
        what the mirror cannot make.
        """
        return float(np.sqrt(np.mean(self.sigma**2) * self.gain / (2 - self.gain)))

    def __call__(self, counts: ArrayLike, out: NDArray | None = None) -> NDArray[np.floating]:
        """Commands that a frame shows, times the gain: subtract them from those of the mirror.

        Parameters
        ----------
        counts : array_like, shape of the mask
            As the camera gives them, of any real type, the dark included.
        out : ndarray of float32, shape (n_commands,), optional
            Where the commands go; a new array if left out.

        Returns
        -------
        ndarray, shape (n_commands,)

        Raises
        ------
        TypeError, ValueError
            If counts or `out` have another shape or type.
        """
        counts, out = _checked(counts, self.mask.shape, out, self.n_commands)
        if self._raw.dtype != counts.dtype:  # the first frame of a type
            self._raw = np.empty(len(self._pixels), counts.dtype)
        signal = self._signal
        counts.take(self._pixels, out=self._raw, mode="clip")
        np.subtract(self._raw, self.dark, out=signal, casting="same_kind")
        light = float(signal @ self._ones)
        self.n_bad = 0
        if not (abs(light) < _check.LARGEST and self._raw.max() < self.saturation):
            light = self._repaired()
        self.flux, self.lost = light / self.light, not light > self._faintest
        if self.lost:
            out[:] = 0
            return out
        signal -= np.multiply(self.reference, np.float32(light), out=self._expected)
        np.dot(self.matrix, signal, out=out)
        out *= np.float32(1 / light)
        return out

    def _repaired(self) -> float:
        """Replace bad pixels of the signal by the reference, and return the light of all."""
        signal = self._signal
        with np.errstate(invalid="ignore"):
            bad = ~((np.abs(signal) < _check.LARGEST) & (self._raw < self.saturation))
        self.n_bad = int(np.count_nonzero(bad))
        share = float(self.reference[~bad].sum())
        light = float(signal[~bad].sum()) / share if share > 0 else 0.0
        signal[bad] = self.reference[bad] * light
        return light

    def save(self, path: str | Path) -> None:
        """Write the controller as NPZ or, where the name ends with .fits, as FITS, in one step.

        Both hold the arrays `matrix`, `reference`, `mask`, `dark`, `interaction` and `noise` of this object under
        their names: the members of the NPZ file are NPY files, and the units of the FITS file images with the
        matrix first. Scalars are 0-dimensional arrays of NPZ, and the keywords LIGHT, GAIN, NKEPT and SATURATE of
        the first header.
        """
        path = path_of("path", path)
        arrays = {name: getattr(self, name) for name in _NAMES}
        arrays["mask"] = self.mask.astype(np.uint8)
        scalars = {"light": self.light, "gain": self.gain, "nkept": self.n_kept, "saturate": self.saturation}
        if path.suffix.lower() in (".fits", ".fit"):
            cards = [(name.upper(), value, "") for name, value in scalars.items() if np.isfinite(value)]
            units = [
                (array, name.upper(), [] if number else cards)
                for number, (name, array) in enumerate(arrays.items())
            ]
            write_file(path, fits_content(*units))
            return
        stream = io.BytesIO()
        np.savez(stream, **arrays, **{name: np.array(value) for name, value in scalars.items()})
        write_file(path, stream.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> Controller:
        """Read a controller that `save` wrote.

        Raises
        ------
        FileNotFoundError, TypeError, ValueError
            ValueError is a FileError if the file is broken or is not a controller.
        """
        path = path_of("path", path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file: expected a controller")
        with broken(f"{path.name}: not a controller, or a broken one"):
            with path.open("rb") as file:
                is_fits = file.read(len(FIRST_BYTES)) == FIRST_BYTES
            values: dict[str, Any]
            if is_fits:
                with fits_module().open(path) as units:
                    values = {name: np.asarray(units[name.upper()].data) for name in _NAMES}
                    header = units[0].header
                    values |= {name: header[name] for name in ("light", "gain", "nkept")}
                    values["saturate"] = header.get("saturate", np.inf)
            else:
                with np.load(path, allow_pickle=False) as file:
                    values = {name: file[name] for name in (*_NAMES, "light", "gain", "nkept", "saturate")}
            scalars = {name: float(values.pop(name)) for name in ("light", "gain", "saturate")}
            n_kept = int(values.pop("nkept"))
            values["mask"] = values["mask"] > 0
            return cls(
                **values,
                light=scalars["light"],
                gain=scalars["gain"],
                n_kept=n_kept,
                saturation=scalars["saturate"],
            )


class PhaseController:
    """Commands from camera counts by the phase of each frame: slower than `Controller`, and farther from flat.

    Make one with `Calibration.controller`. The phase-shifted iteration starts from the phase of the frame before.
    With the likelihood, the directions of the commands are the unknowns, and the commands have error bars. The
    light of a frame is the mean of its pupil over that of the flat mirror.

    Attributes
    ----------
    matrix : ndarray, shape (n_commands, n_points)
        From phases of the good points to commands, the gain included.
    gain : float
    n_kept : int
        Directions of the commands that are inverted.
    phase : ndarray, shape (ny, nx), radian
        Of the last frame, with which the next one starts; 0 outside the pupil.
    sigma : ndarray, shape (n_commands,)
        With the likelihood: standard error of the commands of the last frame, before the gain; else NaN.
    flux, n_bad, lost : float, int and bool
        As those of `Controller`. The bad pixels are those that are good in the calibration.
    """

    def __init__(
        self, calibration: Calibration, pokes: _Pokes, faintest: float, *, poke: float, rcond: float, gain: float,
        likelihood: bool, n_iterations: int,
    ) -> None:  # fmt: skip
        self._calibration = replace(calibration, n_iterations=n_iterations, tolerance=0.0)
        self._work, self._faintest = self._calibration._work, faintest
        flat, modes = pokes.phases(calibration)
        modes /= poke
        self._points = np.flatnonzero(calibration.good)
        inverse = Inverse.of(modes.reshape(len(modes), -1)[:, self._points].T, rcond)
        self.matrix = read_only((gain * inverse.matrix).astype(np.float32))
        self.gain, self.n_kept, self.n_commands = gain, len(inverse.directions), len(modes)
        self._weights = (calibration.weights / calibration.unit[:, np.newaxis, np.newaxis]).astype(np.float32)
        self._mean = (calibration.good.ravel() / len(self._points)).astype(np.float32)
        self._light: NDArray[np.float32] = np.ones(2, np.float32)
        self._light = self._on_grid(pokes.flat)[1] / np.float32(flat.flux)
        self._change, self._turns = np.empty((2, len(self._points)), np.float32)
        self.phase: NDArray[np.float32] = flat.filled
        self.sigma = np.full(self.n_commands, np.nan)
        self.flux, self.n_bad, self.lost = float(flat.flux), 0, False
        self._likelihood: MaximumLikelihood | None = None
        if likelihood:
            self._directions = inverse.directions
            self._likelihood = self._of_directions(np.tensordot(inverse.directions, modes, 1))
            self.phase = self._most_likely(self._frames(pokes.flat)[0])
        self._flat = self.phase.ravel()[self._points]

    def __repr__(self) -> str:
        how = "likelihood" if self._likelihood else f"{self._calibration.n_iterations} iterations"
        return (
            f"PhaseController({len(self._points)} points to {self.n_commands} commands by {how}, "
            f"{self.n_kept} directions, gain={self.gain:g})"
        )

    def __call__(self, counts: ArrayLike, out: NDArray | None = None) -> NDArray[np.floating]:
        """Commands that a frame shows, times the gain: as those of `Controller`, whose parameters these are."""
        counts, out = _checked(counts, _image_shape(self._calibration), out, self.n_commands)
        frames, self.flux, self.n_bad = self._frames(counts)
        self.lost = not self.flux > self._faintest
        if self.lost:
            out[:] = 0
            return out
        change = self._change
        if self._likelihood:
            phase = self._most_likely(frames)
            np.subtract(phase.ravel()[self._points], self._flat, out=change)
        else:
            phase = self._work.reconstruct.solve(frames, self.phase[np.newaxis], False).phase[0]
            self._wrapped(phase)
            phase -= change.mean()  # frames do not show the piston, which noise would move from start to start
        self.phase = phase
        return np.dot(self.matrix, change, out=out)

    def _on_grid(self, counts: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32], int]:
        """Counts on the grid, (2, ny, nx), their light over that of the flat mirror, (2,), and bad pixels."""
        calibration = self._calibration
        images = counts.reshape(1, calibration.n_images, *calibration.shape)
        values, _, n_bad, _ = self._work.on_grid(images, calibration.saturation, calibration.good)
        return (
            values[0].reshape(2, *self._work.offset.shape[1:]),
            values[0] @ self._mean / self._light,
            int(n_bad[0]),
        )

    def _frames(self, counts: NDArray) -> tuple[NDArray[np.float32], float, int]:
        """Ideal frames, (1, n_masks, ny, nx), light over that of the flat mirror, and bad pixels."""
        work, (values, light, n_bad) = self._work, self._on_grid(counts)
        flux = float(light.mean())
        if not self._calibration.balance:
            light = np.full(2, flux, np.float32)
        values /= np.maximum(light, 1e-30)[:, np.newaxis, np.newaxis]
        frames = self._weights[:, 0] * values[0]
        frames += self._weights[:, 1] * values[1]
        frames += work.offset
        frames = frames[: work.reconstruct.sensor.n_masks]
        flat = frames.reshape(len(frames), -1)
        flat[:, work.holes[0]] = flat[:, work.holes[1]]
        return frames[np.newaxis], flux, n_bad

    def _wrapped(self, phase: NDArray) -> None:
        """Difference of a phase from that of the flat mirror at the good points, in half a turn of 0."""
        change, turns = self._change, self._turns
        phase.take(self._points, out=change, mode="clip")
        change -= self._flat
        np.multiply(change, np.float32(0.5 / np.pi), out=turns)
        np.rint(turns, out=turns)
        turns *= np.float32(2 * np.pi)
        change -= turns

    def _of_directions(self, modes: NDArray) -> MaximumLikelihood:
        """Method with these modes and the phase of the flat mirror, which the mirror may not make."""
        pupil = self._calibration.sensor.pupil
        rms = pupil.rms(self.phase)
        basis = modes if rms < _STILL else np.concatenate([modes, self.phase[np.newaxis] / rms])
        return MaximumLikelihood(self._calibration.sensor, np.where(pupil.inside, basis, 0), n_starts=1)

    def _most_likely(self, frames: NDArray) -> NDArray[np.float32]:
        """Phase of the directions of the commands, and `sigma`."""
        assert self._likelihood is not None
        result = self._likelihood(frames[0], self.phase)
        model = result.settings.model(Kind.numpy())
        psi = model.incoming(np.nan_to_num(result.phase, nan=0.0).astype(float)[np.newaxis])
        information = result.estimator.information(psi, model.propagate(psi))
        covariance = np.linalg.inv(result.estimator.of_modes(information)[0]) * float(result.noise_variance)
        ways = self._directions
        self.sigma = np.sqrt(np.einsum("ki,kl,li->i", ways, covariance[: len(ways), : len(ways)], ways))
        return np.nan_to_num(result.phase, nan=0.0)


class Inverse(NamedTuple):
    """Inverse of an interaction matrix, without the directions that it hardly shows."""

    matrix: NDArray[np.float64]  # (n_commands, n_values)
    directions: NDArray[np.float64]  # (n_kept, n_commands), orthonormal

    @classmethod
    def of(cls, interaction: NDArray, rcond: float, noise: float = 0.0) -> Inverse:
        """Inverse of a matrix (n_values, n_commands) whose numbers have an error of `noise`.

        The error adds noise**2 * n_values to each eigenvalue of J^T J. That is subtracted, because it would lower
        the gain of weak directions. A direction that is no stronger than that is left out, as is one below `rcond`
        times the strongest.
        """
        values, vectors = np.linalg.eigh(interaction.T @ interaction)
        floor = noise**2 * len(interaction)
        strength = values - floor
        least = max(rcond**2 * strength[-1], (_UNSEEN**2 - 1) * floor, 1e-14 * values[-1])
        shown = strength > least
        ways = vectors[:, shown].T
        return cls((ways.T / strength[shown]) @ (ways @ interaction.T), ways)


class _Pokes(NamedTuple):
    """Mean frames of a flat mirror and of pokes, counts, the dark included."""

    flat: NDArray[np.float64]  # (..., ny, nx)
    pushed: NDArray[np.float64]  # (n_commands, ..., ny, nx)
    pulled: NDArray[np.float64]
    n_flat: int  # frames of the mean
    n_averaged: int
    good: NDArray[np.bool_]  # (..., ny, nx), pixels that are good in all frames

    @classmethod
    def of(cls, calibration: Calibration, flat: Any, pushed: Any, pulled: Any) -> _Pokes:
        """Check and average frames, which are arrays or files."""
        image = _image_shape(calibration)
        frames = [
            _frames_of(name, value, calibration)
            for name, value in (("flat", flat), ("pushed", pushed), ("pulled", pulled))
        ]
        for name, one in zip(("pushed", "pulled"), frames[1:], strict=True):
            if one.ndim == len(image) or one.shape != frames[1].shape:
                expected = ", ".join(map(str, image))
                raise ValueError(
                    f"{name} has shape {one.shape}: expected (n_commands, {expected}), as many as the other"
                )
        good = np.ones(image, bool)
        with np.errstate(invalid="ignore"):
            for one in frames:
                usable = (one < calibration.saturation) & (one > -_check.LARGEST)
                good &= usable.reshape(-1, *image).all(axis=0)
        n_commands = len(frames[1])
        means = [one.reshape(*lead, -1, *image).mean(axis=len(lead), dtype=float) for one, lead in
                 zip(frames, ((), (n_commands,), (n_commands,)), strict=True)]  # fmt: skip
        return cls(
            *means, prod(frames[0].shape[: -len(image)]), frames[1].size // (n_commands * prod(image)), good
        )

    def phases(self, calibration: Calibration) -> tuple[Phases, NDArray[np.float64]]:
        """Phases of the flat mirror, and half the difference of push and pull without its mean, (n, ny, nx)."""
        flat, pushed, pulled = (
            calibration(np.where(self.good, images, np.nan)) for images in (self.flat, self.pushed, self.pulled)
        )
        for name, phases in (("flat", flat), ("pushed", pushed), ("pulled", pulled)):
            if np.any(phases.flags & Flag.LOST):
                lost = np.flatnonzero(np.atleast_1d(phases.flags & Flag.LOST))
                raise ValueError(f"{name}: its frames {lost.tolist()} are lost: expected light in all of them")
        half = np.angle(np.exp(1j * (pushed.filled.astype(float) - pulled.filled))) / 2
        mean = half[:, calibration.good].mean(axis=1)
        return flat, np.where(calibration.amplitude > 0, half - mean[:, np.newaxis, np.newaxis], 0)


class _Signals(NamedTuple):
    """Frames over their own light, at the pixels that count."""

    mask: NDArray[np.bool_]
    dark: NDArray[np.float64]  # (n_pixels,), counts
    light: float  # of the flat mirror, counts
    reference: NDArray[np.float64]  # (n_pixels,)
    difference: NDArray[np.float64]  # (n_commands, n_pixels), half of that of push and pull
    asymmetry: NDArray[np.float64]  # their mean, less the reference
    noise: NDArray[np.float64]  # (n_pixels,), of one frame of the flat mirror
    shares: tuple[float, float]  # of the variance of a frame, in those of difference and asymmetry

    @classmethod
    def of(cls, calibration: Calibration, pokes: _Pokes) -> _Signals:
        """Signals of pokes."""
        mask = _pixels(calibration)
        n_pixels = np.count_nonzero(mask)
        mask &= pokes.good
        if np.count_nonzero(mask) < _FEWEST * n_pixels:
            raise ValueError(
                f"flat, pushed, pulled: {np.count_nonzero(mask)} of the {n_pixels} pixels of the pupils are good "
                f"in all frames: expected {100 * _FEWEST:.0f} % of them, none of them NaN or saturated"
            )
        stray = calibration.background if calibration.n_images == 2 else calibration.background.mean(keepdims=True)
        dark = (calibration.dark + stray[:, np.newaxis, np.newaxis]).reshape(mask.shape)[mask]
        signals, lights = [], []
        for name, images in (("flat", pokes.flat[np.newaxis]), ("pushed", pokes.pushed), ("pulled", pokes.pulled)):
            values = images[:, mask] - dark
            light = values.sum(axis=1)
            if np.any(dim := light <= 0):
                raise ValueError(
                    f"{name}: frames {np.flatnonzero(dim).tolist()} have no light: expected some in all"
                )
            signals.append(values / light[:, np.newaxis])
            lights.append(light)
        [reference], pushed, pulled = signals
        asymmetry = (pushed + pulled) / 2 - reference
        shares = 1 / (2 * pokes.n_averaged), 1 / (2 * pokes.n_averaged) + 1 / pokes.n_flat
        noise = _noise(asymmetry, reference, mask) / np.sqrt(shares[1])
        return cls(mask, dark, float(lights[0][0]), reference, (pushed - pulled) / 2, asymmetry, noise, shares)

    @property
    def faintest(self) -> float:
        """Light, over that of the flat mirror, below which a frame is lost."""
        return max(_LOST * float(np.linalg.norm(self.noise)), 1e-12)

    def weights(self) -> tuple[NDArray[np.float64], float]:
        """Weight of each pixel, one over its noise, and the error of half a difference times that."""
        typical = np.sqrt(np.mean(self.noise**2))
        if not typical > 0:
            return np.ones_like(self.noise), 0.0
        return typical / self.noise, typical * np.sqrt(self.shares[0])

    def check(self) -> None:
        """Refuse pokes that do not move the frames, contradict themselves, or equal each other."""
        variance = np.sum(self.noise**2)
        size, skew = (np.sum(one**2, axis=1) for one in (self.difference, self.asymmetry))
        noise, noise_skew = (share * variance for share in self.shares)
        still = size < max(_UNMOVED * noise, _SILENT * np.median(size))
        _refuse(still, "do not move the frames beyond their noise", "pokes that do, or brighter frames")
        moved = size - noise
        contrary = skew - noise_skew > _CONTRARY**2 * moved + 0.1 * (noise + noise_skew)
        _refuse(contrary, "contradict each other", "opposite changes of the frames of the flat mirror")
        product = np.abs(self.difference @ self.difference.T)
        both = np.add.outer(moved, moved)
        apart = np.add.outer(size, size) - 2 * product - 2 * noise
        clear = np.minimum.outer(moved, moved) > _CLEAR * noise
        alike = np.triu(clear & (apart < _ALIKE * both), 1)
        if alike.any():
            first, second = np.argwhere(alike)[0]
            raise ValueError(
                f"pushed and pulled: pokes {first} and {second} move the frames in the same way: expected "
                "different actuators, each of them once"
            )


def _refuse(which: NDArray[np.bool_], what: str, expected: str) -> None:
    if which.any():
        raise ValueError(
            f"pushed and pulled of pokes {np.flatnonzero(which).tolist()} {what}: expected {expected}"
        )


def _noise(asymmetry: NDArray, reference: NDArray, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Standard error of each pixel of frames (n, n_pixels), a constant plus a part that grows with the light.

    Second differences of three neighbours on a row show it, since a wavefront is smoother.
    """
    pixels = np.flatnonzero(mask)
    middle = np.flatnonzero(pixels[2:] - pixels[:-2] == 2) + 1
    rough = (asymmetry[:, middle - 1] - 2 * asymmetry[:, middle] + asymmetry[:, middle + 1]) / np.sqrt(6)
    parts = np.array_split(np.argsort(reference[middle]), _BINS)
    level = np.array([reference[middle[part]].mean() for part in parts])
    variance = np.array([(1.4826 * np.median(np.abs(rough[:, part]))) ** 2 for part in parts])
    mean = level.mean()
    slope = np.clip(
        (level - mean) @ (variance - variance.mean()) / max(np.sum((level - mean) ** 2), 1e-300),
        0,
        variance.mean() / mean,
    )
    return np.sqrt(np.maximum(variance.mean() + slope * (reference - mean), _DIMMEST * variance.mean()))


def _pixels(calibration: Calibration) -> NDArray[np.bool_]:
    """Good pixels of the camera next to a point of the pupil, in either image."""
    mask = np.zeros((calibration.n_images, *calibration.shape), bool)
    for index, places in enumerate(calibration.places):
        low = np.floor(places[:, calibration.amplitude > 0]).astype(int)
        for step in ((0, 0), (0, 1), (1, 0), (1, 1)):
            row, column = (low.T + step).T
            seen = (row >= 0) & (row < calibration.shape[0]) & (column >= 0) & (column < calibration.shape[1])
            mask[min(index, calibration.n_images - 1), row[seen], column[seen]] = True
    return (mask & ~calibration.bad).reshape(_image_shape(calibration))


def _frames_of(name: str, value: Any, calibration: Calibration) -> NDArray:
    """Camera images from an array or a file."""
    if isinstance(value, str | Path):
        stack = Stack([path_of(name, value)], [], calibration.n_images, calibration.shape)
        value = stack.read(0, stack.n).reshape(stack.n, *_image_shape(calibration))
    array = _check.plain_array(name, value)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{name} has dtype {array.dtype}: expected real numbers")
    _check.maps(name, array, _image_shape(calibration), "the camera image of the calibration")
    return array


def _image_shape(calibration: Calibration) -> tuple[int, ...]:
    """Shape of one exposure."""
    return calibration.shape if calibration.n_images == 1 else (2, *calibration.shape)


def _checked(counts: Any, shape: tuple[int, ...], out: Any, n_commands: int) -> tuple[NDArray, NDArray]:
    """Counts of one exposure, and where the commands go."""
    if not isinstance(counts, np.ndarray):
        counts = _check.plain_array("counts", counts)
    if counts.dtype.kind not in "biuf":
        raise TypeError(f"counts has dtype {counts.dtype}: expected real numbers")
    if counts.shape != shape:
        raise ValueError(f"counts has shape {counts.shape}: expected {shape}, one exposure of the calibration")
    if out is None:
        return counts, np.empty(n_commands, np.float32)
    if not isinstance(out, np.ndarray) or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise TypeError(f"out is {_check.shown(out)}: expected an array of float32")
    if out.shape != (n_commands,):
        raise ValueError(f"out has shape {out.shape}: expected {(n_commands,)}")
    return counts, out
