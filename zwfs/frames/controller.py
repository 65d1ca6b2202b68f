"""Controllers of a loop: camera counts to commands of a mirror, calibrated by pokes of its actuators.

The frames of a loop are close to those of the flat mirror, and differ from them by a linear function of the
commands. With the dark d, a frame over its own light, x = (c - d) / sum(c - d), does not depend on the star, and

    commands = gain M (x - r),    J = (x_pushed - x_pulled) / 2 poke,    M = inverse of J,

where r is x of the flat mirror. `Controller` is this product: the pixels of the camera need no resampling.
`PhaseController` computes the phase of each frame first, which takes longer and reaches farther.
"""

from __future__ import annotations

import io
import math
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Kind, read_only
from zwfs._system import path_of, write_file
from zwfs.frames._blocks import broken
from zwfs.frames._fits import FIRST_BYTES, fits_content, fits_module
from zwfs.frames._pokes import (
    Inverse,
    Pokes,
    Signals,
    beyond_noise,
    faintest,
    image_shape,
    phases_of,
    roughness,
    surroundings,
)
from zwfs.reconstructors import MaximumLikelihood
from zwfs.reconstructors._tracking import Tracking

if TYPE_CHECKING:
    from zwfs.frames.calibration import Calibration

__all__ = ["Controller", "PhaseController"]

_STILL = 1e-3  # radian rms of the flat mirror's phase, below which it needs no mode
_METHODS = "linear", "phase-shifted", "likelihood"
_SUFFIXES = ".npz", ".fits"
# Arrays and numbers of a file; the numbers with the value of one that is missing, since FITS has no infinity.
_ARRAYS = "matrix", "reference", "mask", "dark", "interaction", "around"
_NUMBERS = {"light": np.inf, "noise": 0.0, "gain": 1.0, "n_kept": 1.0, "saturation": np.inf, "stray": 0.0}
_PHASE_ARRAYS = "modes", "flat", "calibration"
_PHASE_NUMBERS = {"faintest": 0.0, "rcond": 0.0, "gain": 1.0, "likelihood": 0.0, "n_iterations": 1.0}


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
    _check.choice("method", method, _METHODS)
    pokes = Pokes.of(calibration, flat, pushed, pulled)
    signals = Signals.of(calibration, pokes)
    signals.check()
    if method != "linear":
        flat = np.where(pokes.good, pokes.flat, np.nan)
        modes = pokes.modes(replace(calibration, bench=None)) / np.float32(poke)
        return PhaseController(
            calibration, flat, modes, faintest=signals.faintest, rcond=rcond, gain=gain,
            likelihood=method == "likelihood", n_iterations=n_iterations,
        )  # fmt: skip
    interaction = signals.difference.T / poke
    inverse = Inverse.of(interaction, rcond, signals.noise * math.sqrt(signals.shares[0]) / poke)
    around, stray = surroundings(calibration, pokes.flat, pokes.good)
    return Controller(
        gain * inverse.matrix, signals.reference, signals.mask, signals.dark, interaction, light=signals.light,
        noise=signals.noise, gain=gain, n_kept=len(inverse.directions), saturation=calibration.saturation,
        around=around, stray=stray,
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
    light : float, counts
        Sum of the frame of the flat mirror, less the dark.
    noise : float
        Standard error of the signal of a pixel, in one frame of the flat mirror, rms.
    gain : float
    n_kept : int
        Directions of the commands that are inverted.
    saturation : float, counts
        Pixels that reach it are bad.
    around, stray : array_like, shape of the mask, and float, counts, optional
        Weights of pixels around the pupils, and what they make of the dark: sum(around * counts) - stray is the
        uniform light that the frame of the flat mirror did not have.

    Attributes
    ----------
    flux : float
        Light of the last frame over that of the flat mirror.
    background : float
        Uniform light of the last frame that the flat mirror did not have, over the mean of its pixels. It is not
        subtracted; 0 if the camera image shows too little around the pupils.
    n_bad : int
        Pixels of the last frame that were replaced.
    lost : bool
        Whether the last frame had no light, or no pupil: then the commands are 0.
    """

    def __init__(
        self, matrix: ArrayLike, reference: ArrayLike, mask: ArrayLike, dark: ArrayLike, interaction: ArrayLike,
        *, light: float, noise: float, gain: float, n_kept: int, saturation: float = np.inf,
        around: ArrayLike | None = None, stray: float = 0.0,
    ) -> None:  # fmt: skip
        flags = _check.plain_array("mask", mask)
        self.mask = read_only(_check.flag_map("mask", flags, flags.shape).copy())
        if self.mask.ndim not in (2, 3):
            raise ValueError(f"mask has shape {self.mask.shape}: expected (ny, nx) or (2, ny, nx)")
        if not self.mask.any():
            raise ValueError("mask is False at all pixels: expected some to be True")
        n, n_commands = int(np.count_nonzero(self.mask)), len(np.atleast_1d(matrix))
        around = np.zeros(self.mask.shape) if around is None else around
        self.around, self.stray = _single("around", around, self.mask.shape), _check.number("stray", stray)
        far = np.flatnonzero(self.around)
        self._pixels, self._weights = np.concatenate([np.flatnonzero(self.mask), far]), self.around.ravel()[far]
        self.matrix = _single("matrix", matrix, (n_commands, n))
        self.reference, self.dark = _single("reference", reference, (n,)), _single("dark", dark, (n,))
        self.interaction = _single("interaction", interaction, (n, n_commands))
        self.light = _check.number("light", light, 0, open_low=True)
        self.noise = _check.number("noise", noise, 0)
        self.gain = _check.number("gain", gain, 0, 2, open_low=True)
        self.n_kept = _check.integer("n_kept", n_kept, 1, n_commands)
        self.saturation = _check.number_or_inf("saturation", saturation)
        self.flux, self.background, self.n_bad, self.lost = 1.0, 0.0, 0, False
        self._faintest, self._mean = faintest(self.noise, n) * self.light, self.light / n
        self._ones, self._expected = np.ones(n, np.float32), np.empty(n, np.float32)
        self._darks = np.concatenate([self.dark, 0 * self._weights])
        self._raw, self._values = np.empty_like(self._darks), np.empty_like(self._darks)
        self._signal, self._far = self._values[:n], self._values[n:]

    def __repr__(self) -> str:
        return (
            f"Controller({len(self.reference)} pixels to {self.n_commands} commands, {self.n_kept} directions, "
            f"gain={self.gain:g})"
        )

    @property
    def n_commands(self) -> int:
        """Number of commands."""
        return len(self.matrix)

    @property
    def sigma(self) -> NDArray[np.float32]:
        """Standard error of each command before the gain, by the photon noise of a frame of the flat mirror."""
        share = np.sqrt(np.maximum(self.reference, 0) * len(self.reference))
        return self.noise * np.linalg.norm(self.matrix * share, axis=1) / self.gain

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
        counts = _check.real_frame("counts", counts, self.mask.shape)
        out = _check.destination("out", out, (self.n_commands,))
        if self._raw.dtype != counts.dtype:  # the first frame of a type
            self._raw = np.empty(len(self._pixels), counts.dtype)
        signal = self._signal
        counts.take(self._pixels, out=self._raw, mode="clip")
        self._values[:] = self._raw
        self._values -= self._darks
        light, level = float(signal.dot(self._ones)), float(self._far.dot(self._weights)) - self.stray
        self.n_bad = 0
        if not (abs(light) < _check.LARGEST and self._raw.max() < self.saturation):
            light = self._repaired()
        self.flux, self.background = light / self.light, level / self._mean
        self.lost = not light > self._faintest or bool(
            2 * self.background > self.flux and beyond_noise(level, self._weights, self._far)
        )
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
            bad = ~((np.abs(signal) < _check.LARGEST) & (self._raw[: len(signal)] < self.saturation))
        self.n_bad = int(np.count_nonzero(bad))
        share = float(self.reference[~bad].sum())
        light = float(signal[~bad].sum()) / share if share > 0 else 0.0
        signal[bad] = self.reference[bad] * light
        return light

    def save(self, path: str | Path) -> None:
        """Write the controller as NPZ or FITS, by the end of the name, in one step.

        Both hold `matrix`, `reference`, `mask` (1 and 0), `dark`, `interaction` and `around` of this object under
        their names: as the NPY files of which an NPZ file consists, or as images of FITS units, with the matrix
        first. The numbers `light`, `noise`, `gain`, `n_kept`, `saturation` and `stray` are arrays without an axis
        in NPZ. In FITS they are keywords of the first header, cut to 8 letters; one that is infinite is left out.

        Raises
        ------
        TypeError, ValueError
            If the name ends differently, or is that of a file that holds no controller.
        """
        arrays = {name: getattr(self, name) for name in _ARRAYS} | {"mask": self.mask.astype(np.uint8)}
        _write(path, arrays, {name: getattr(self, name) for name in _NUMBERS})

    @classmethod
    def load(cls, path: str | Path) -> Controller:
        """Read a controller that `save` wrote.

        Raises
        ------
        FileNotFoundError, TypeError, ValueError
            ValueError is a FileError if the file is broken or is not a controller.
        """
        values = _read(path, _ARRAYS, _NUMBERS)
        with _broken(path):
            return cls(**values | {"mask": values["mask"] > 0, "n_kept": int(values["n_kept"])})


class PhaseController:
    """Commands from camera counts by the phase of each frame: slower than `Controller`, and farther from flat.

    Make one with `Calibration.controller`. The phase-shifted iteration starts from the phase of the frame before.
    With the likelihood, the directions of the commands are the unknowns, and the commands have error bars. The
    light of a frame is the mean of its pupil over that which the model expects of the phase before.

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
    flux, background, n_bad, lost : float, float, int and bool
        As those of `Controller`. The bad pixels are those that are good in the calibration.
    """

    def __init__(
        self, calibration: Calibration, flat: NDArray, modes: NDArray, *, faintest: float, rcond: float,
        gain: float, likelihood: bool, n_iterations: int,
    ) -> None:  # fmt: skip
        self._saved: dict[str, Any] = {
            "modes": modes, "flat": flat, "faintest": faintest, "rcond": rcond, "gain": gain,
            "likelihood": likelihood, "n_iterations": n_iterations,
        }  # fmt: skip
        self._of = calibration
        calibration = replace(calibration, bench=None)  # a loop has no time for its corrections
        self._calibration = replace(calibration, n_iterations=n_iterations, tolerance=0.0)
        self._work, self._faintest = self._calibration._work, faintest
        self._straight = self._work.straight(calibration.saturation)
        self._tracking = None if likelihood else Tracking.of(self._work.reconstruct)
        level = phases_of("flat", flat, calibration)
        self._points = np.flatnonzero(calibration.good)
        responses = modes.reshape(len(modes), -1)[:, self._points]
        inverse = Inverse.of(responses.T, rcond, roughness(responses, self._points))
        self.matrix = read_only((gain * inverse.matrix).astype(np.float32))
        self.gain, self.n_kept, self.n_commands = gain, len(inverse.directions), len(modes)
        weights = (calibration.weights / calibration.unit[:, np.newaxis, np.newaxis]).astype(np.float32)
        self._own, crossed = weights[(0, 1), (0, 1)], weights[(0, 1), (1, 0)]
        self._crossed = crossed if crossed.any() else None  # of the other image
        inside, (holes, nearest) = calibration.sensor.pupil.inside.ravel(), self._work.holes
        self._mean = inside.astype(np.float32) / np.float32(np.count_nonzero(inside))
        np.add.at(self._mean, nearest, self._mean[holes])
        self._mean[holes] = 0
        self._stop = calibration.sensor.pupil.inside.astype(np.float32)
        self._stray = float(np.mean(self._work.offset.reshape(2, -1) @ self._mean))
        self._light: NDArray[np.float32] = np.ones(2, np.float32)
        self._light = self._on_grid(flat)[1] / np.float32(level.flux)
        self._mean_light = float(self._light.mean())
        self._change, self._turns = np.empty((2, len(self._points)), np.float32)
        self.phase: NDArray[np.float32] = level.filled
        self.sigma = np.full(self.n_commands, np.nan)
        self.flux, self.background, self.n_bad, self.lost = float(level.flux), 0.0, 0, False
        around, self._stray_around = surroundings(calibration, flat, np.isfinite(flat))
        self._far, self._weights = np.flatnonzero(around), around[around != 0]
        self._likelihood: MaximumLikelihood | None = None
        if likelihood:
            self._directions = inverse.directions
            self._likelihood = self._of_directions(np.tensordot(inverse.directions, modes, 1))
            self.phase = self._most_likely(self._frames(flat, 1.0)[0])
        self._flat = self.phase.ravel()[self._points]
        self._flat_brightness = self._brightness()

    def __repr__(self) -> str:
        how = "likelihood" if self._likelihood else f"{self._calibration.n_iterations} iterations"
        return (
            f"PhaseController({len(self._points)} points to {self.n_commands} commands by {how}, "
            f"{self.n_kept} directions, gain={self.gain:g})"
        )

    def __call__(self, counts: ArrayLike, out: NDArray | None = None) -> NDArray[np.floating]:
        """Commands that a frame shows, times the gain: as those of `Controller`, whose parameters these are."""
        counts = _check.real_frame("counts", counts, image_shape(self._calibration))
        out = _check.destination("out", out, (self.n_commands,))
        frames, self.flux, self.n_bad = self._frames(counts, self._brightness() / self._flat_brightness)
        far = counts.take(self._far).astype(np.float32)
        level = float(far.dot(self._weights)) - self._stray_around
        self.background = level / self._mean_light
        self.lost = not self.flux > self._faintest or (
            2 * self.background > self.flux and beyond_noise(level, self._weights, far)
        )
        if self.lost:
            out[:] = 0
            return out
        change = self._change
        if self._likelihood:
            phase = self._most_likely(frames)
            np.subtract(phase.ravel()[self._points], self._flat, out=change)
        else:
            if self._tracking:
                phase = self._tracking(frames[0])
            else:
                phase = self._work.reconstruct.solve(frames, self.phase[np.newaxis], False).phase[0]
            self._wrapped(phase)
            phase -= change.mean()  # frames do not show the piston, which noise would move from start to start
            phase *= self._stop
        self.phase = phase
        return np.dot(self.matrix, change, out=out)

    def save(self, path: str | Path) -> None:
        """Write what the pokes have shown as NPZ or FITS, by the end of the name, in one step.

        The file holds `modes` (n_commands, ny, nx), the phase of a unit of each command in radian, `flat`, the
        counts of the flat mirror, and a checksum of the calibration, which `Calibration.save` writes.

        Raises
        ------
        TypeError, ValueError
            As `Controller.save`.
        """
        arrays = {name: self._saved[name] for name in ("modes", "flat")} | {"calibration": _digest(self._of)}
        _write(path, arrays, {name: float(self._saved[name]) for name in _PHASE_NUMBERS})

    @classmethod
    def load(cls, path: str | Path, calibration: Calibration) -> PhaseController:
        """Read a controller that `save` wrote, for the calibration with which it was made.

        Raises
        ------
        FileNotFoundError, TypeError, ValueError
            ValueError is a FileError if the file is broken or is not such a controller.
        """
        values = _read(path, _PHASE_ARRAYS, _PHASE_NUMBERS)
        if not np.array_equal(values.pop("calibration"), _digest(calibration)):
            raise ValueError(f"calibration: expected the one with which the controller {str(path)!r} was made")
        with _broken(path):
            values |= {"modes": values["modes"].astype(np.float32), "flat": values["flat"].astype(float)}
            values |= {"likelihood": values["likelihood"] > 0, "n_iterations": int(values["n_iterations"])}
            return cls(calibration, **values)

    def _on_grid(self, counts: NDArray) -> tuple[NDArray[np.floating], NDArray[np.floating], int]:
        """Counts on the grid, (2, ny, nx), their light over that of the flat mirror, (2,), and bad pixels."""
        calibration, n_bad = self._calibration, 0
        images = counts.reshape(-1, *calibration.shape)
        values = self._straight(images) if self._straight else None
        if values is None:
            level, good = calibration.saturation, calibration.good
            on_grid, _, (n_bad,), _ = self._work.on_grid(images[np.newaxis], level, good)
            values = on_grid.reshape(2, *good.shape)
        return values, values.reshape(2, -1) @ self._mean / self._light, int(n_bad)

    def _brightness(self) -> float:
        """Mean light in the pupil of modelled frames of the last phase, from which the next frame starts."""
        if self._tracking:
            return self._tracking.start(self.phase) - self._stray
        frames = self._work.modelled(self.phase[np.newaxis])[0]
        return float(np.mean(frames.reshape(2, -1) @ self._mean)) - self._stray

    def _frames(self, counts: NDArray, brightness: float) -> tuple[NDArray[np.float32], float, int]:
        """Ideal frames, (1, n_masks, ny, nx), light over that of the flat mirror, and bad pixels.

        The light would be `brightness` if the star were that of the flat mirror.
        """
        work, (values, light, n_bad) = self._work, self._on_grid(counts)
        flux = float(light.mean()) / brightness
        light = light / brightness if self._calibration.balance else np.full(2, flux, np.float32)
        values /= np.maximum(light, 1e-30)[:, np.newaxis, np.newaxis]
        frames = self._own * values
        if self._crossed is not None:
            frames += self._crossed * values[::-1]
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


def _digest(calibration: Calibration) -> NDArray[np.uint8]:
    """Checksum of a calibration."""
    return np.frombuffer(bytes.fromhex(calibration.sha256), np.uint8)


def _write(path: str | Path, arrays: dict[str, NDArray], numbers: dict[str, float]) -> None:
    """Write a controller; another file of that name is not replaced."""
    path = path_of("path", path)
    if path.suffix.lower() not in _SUFFIXES:
        raise ValueError(f"path = {str(path)!r}: expected a name that ends with {' or '.join(_SUFFIXES)}")
    if path.exists():
        try:
            _read(path, tuple(arrays), numbers)
        except (ValueError, FileNotFoundError):
            raise ValueError(f"path = {str(path)!r} exists and is no controller: expected a new name") from None
    if path.suffix.lower() == ".fits":
        cards = [(name[:8], value, "") for name, value in numbers.items() if value != np.inf]
        first = next(iter(arrays))
        units = [(array, name.upper(), cards if name == first else []) for name, array in arrays.items()]
        content = fits_content(*units)
    else:
        stream = io.BytesIO()
        np.savez(stream, **arrays, **numbers)  # type: ignore[arg-type]
        content = stream.getvalue()
    write_file(path, content)


def _read(path: str | Path, arrays: tuple[str, ...], numbers: dict[str, float]) -> dict[str, Any]:
    """Arrays and numbers of a file; numbers that it lacks are those given."""
    path = path_of("path", path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file: expected a controller")
    with _broken(path):
        with path.open("rb") as file:
            is_fits = file.read(len(FIRST_BYTES)) == FIRST_BYTES
        if is_fits:
            with fits_module().open(path, memmap=False) as units:
                values = {name: unit.data for name, unit in zip(arrays, units, strict=True)}
                return values | {name: units[0].header.get(name[:8], absent) for name, absent in numbers.items()}
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in arrays} | {name: float(stored[name]) for name in numbers}


def _broken(path: str | Path) -> AbstractContextManager[None]:
    return broken(f"{Path(path).name}: a broken controller, or none")


def _single(name: str, value: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Checked constants in single precision."""
    array = _check.real_array(name, value).astype(np.float32, order="C")
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}: expected {shape}")
    _check.finite(name, array)
    return read_only(array)
