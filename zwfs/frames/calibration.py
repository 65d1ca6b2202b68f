"""A calibrated bench: what is computed once, so that camera images become phases in one call.

`Calibration.of` takes it from a measurement with clear frames, `Calibration.from_bench` from a fit of the bench. A
call does the same as `reduce_frames` and `recover_phase` of `zwfs.frames.pipeline`, in single precision.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import zipfile
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Immutable, Kind, read_only
from zwfs._images import radius
from zwfs._likelihood import Estimator, Noise
from zwfs._propagator import propagator, split
from zwfs._system import path_of, write_file
from zwfs.frames._blocks import FileError, broken
from zwfs.frames._errors import Excess, sideways, slopes_of, unexplained
from zwfs.frames._fit import BenchFit, places_of
from zwfs.frames._flux import Trial, explained
from zwfs.frames._grid import Grid
from zwfs.frames._learnt import learnt, training
from zwfs.frames.controller import Controller, PhaseController, make_controller
from zwfs.frames.phases import Flag, Phases
from zwfs.frames.pipeline import _MOST_BAD, Measurement, Optics, ideal_frames
from zwfs.frames.registration import FRAMES
from zwfs.metrics import without_piston
from zwfs.pupil import Pupil
from zwfs.reconstructors.base import Reconstructor
from zwfs.sensor import ZernikeSensor

FORMAT = 2  # of the file; another number is refused
_DIM = 0.1  # of the light of the calibration: a frame with less is compared with its noise
_FAINT = 0.5  # of that light, from which down the noise of dark pixels counts
_UNUSUAL = 2.5  # times the residual of the calibration's frames: a larger one is inconsistent
_EXACT = 1e-3  # residual of frames without noise
_MOVED_BY, _SURE = 0.1, 5.0  # pixels and standard errors, of a displacement
_SAME_LIGHT = 0.01  # relative difference of the light of frames and of their model that means little
_LAMP = (
    0.85,
    1.7,
)  # light in the pupil, over that of the calibration's frames, that other phases can make of its lamp
_FAINTEST = 0.2  # amplitude of the pupil of a fit, relative to the largest
_WIDEST = 2**16  # rows or columns of a camera
_PIECE = 8  # exposures that are handled together: more do not fit the fast memory of a processor
_LOST, _BAD, _SATURATED, _INCONSISTENT, _NOT_CONVERGED, _MOVED = (
    flag.value for flag in Flag
)  # plain, and far quicker


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Immutable):
    """Sensor and camera of a bench: called on camera images, it returns their phases.

    Make one with `of`, `from_bench`, `calibrate` or `load`. It cannot be changed. Its pickle is small, and the
    model of the sensor is made at the first call of each process.

    Attributes
    ----------
    amplitude, good : ndarray of float64 and of bool, shape (ny, nx)
        Amplitude of the pupil, 0 outside, and its good points.
    diameter, center : float and (float, float), pixels
        Diameter D of the pupil, and row and column of the optical axis on its grid.
    optics : Optics
    shape, n_images : (int, int) and int
        Rows and columns of a camera image, and images of an exposure: 1 with both pupils on it, or 2.
    places : ndarray, shape (2, 2, ny, nx), pixels
        Row and column at which each point of the grid of the pupil lies on the camera, for both frames.
    dark, bad : ndarray of float32 and of bool, shape (n_images, ny_camera, nx_camera)
        Counts without light, and pixels that are ignored in all frames.
    background, unit : ndarray, shape (2,), counts
        Stray light of the frames, and counts that make an intensity of 1.
    weights, offset : ndarray, shapes (2, 2, ny, nx) and (2, ny, nx)
        Frames of an ideal sensor are weights @ intensities + offset at each point.
    balance : bool
        Whether both frames are scaled to the same light.
    light : ndarray, shape (2,)
        Mean intensity of the calibration's frames in the pupil.
    light_ratio : float
        Light of the calibration's frames over that of their model, which other frames are taken to share.
    unexplained, slopes : ndarray, shapes (n_states, ny, nx) and (n_states,), radian
        Errors of the phases of the calibration's frames, for `sigma`. They grow with the rms difference of phases
        at neighbouring points.
    displacements : ndarray, shape (n_states, 2), pixels
        Rows and columns by which the rim of the pupil on the calibration's frames differs from the model.
    residual : float
        Rms difference of the calibration's frames and their model, the largest of all states.
    saturation : float, counts
        Pixels that reach it are saturated, the dark included.
    blur : float, pixels rms
        Of the camera's images, which the calibration deconvolves as far as the noise allows.
    n_averaged : int
        Exposures that were averaged for each state.
    commanded : bool
        Whether the grid is that of known commands, and not that of the first image.
    bunit : str
        Unit of the calibration's frames, BUNIT of their header; empty if unknown.
    n_iterations, tolerance : int and float, radian
        As for `PhaseShifted`: with a tolerance of 0, all iterations are done.
    """

    amplitude: NDArray[np.float64]
    diameter: float
    center: tuple[float, float]
    optics: Optics
    shape: tuple[int, int]
    n_images: int
    places: NDArray[np.float64]
    dark: NDArray[np.float32]
    bad: NDArray[np.bool_]
    good: NDArray[np.bool_]
    background: NDArray[np.float64]
    unit: NDArray[np.float64]
    weights: NDArray[np.float64]
    offset: NDArray[np.float64]
    balance: bool
    light: NDArray[np.float64]
    unexplained: NDArray[np.float32]
    slopes: NDArray[np.float64]
    displacements: NDArray[np.float64]
    residual: float = 0.0
    light_ratio: float = 1.0
    saturation: float = np.inf
    blur: float = 0.0
    n_averaged: int = 1
    commanded: bool = False
    bunit: str = ""
    n_iterations: int = 25
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        _check.integer("n_iterations", self.n_iterations, 1)
        _check.number("tolerance", self.tolerance, 0, 2 * np.pi)
        _number_or_inf("saturation", self.saturation, open_low=True)
        _check.instance("bunit", self.bunit, str)
        _check.flag("balance", self.balance)
        _check.number("residual", self.residual, 0)
        _check.number("light_ratio", self.light_ratio, 0, open_low=True)
        _check.number("blur", self.blur, 0, 10)
        _check.integer("n_averaged", self.n_averaged, 1)
        _check.integer("n_images", self.n_images, 1, 2)
        _check.number("diameter", self.diameter, 1)
        _check.pair("center", self.center, _check.number)
        _check.instance("optics", self.optics, Optics)
        _check.flag("commanded", self.commanded)
        shape = _check.pair("shape", self.shape, _check.integer, 1, _WIDEST)
        amplitude = _check.real_map("amplitude", self.amplitude)
        _check.non_negative("amplitude", amplitude)
        grid, camera = amplitude.shape, (self.n_images, *shape)
        n_states = _check.real_array("slopes", self.slopes).size
        bad, good = _check.flag_map("bad", self.bad, camera), _check.flag_map("good", self.good, grid)
        if not np.any(good & (amplitude > 0)):
            raise ValueError("amplitude is 0 at all good points: expected light at some")
        arrays = {"amplitude": amplitude, "bad": bad, "good": good}
        for name, size in {
            "places": (2, 2, *grid), "dark": camera, "background": (2,), "unit": (2,), "weights": (2, 2, *grid),
            "offset": (2, *grid), "light": (2,), "unexplained": (n_states, *grid), "slopes": (n_states,),
            "displacements": (n_states, 2),
        }.items():  # fmt: skip
            array = _check.real_array(name, getattr(self, name))
            if array.shape != size:
                raise ValueError(f"{name} has shape {array.shape}: expected {size}")
            _check.finite(name, array)
            arrays[name] = array
            if name in ("unit", "light") and np.any(array <= 0):
                raise ValueError(f"{name} = {_check.shown(array)}: expected values above 0")
        if np.any(np.abs(arrays["places"]) > 2 * max(shape)):  # the work grows with the distance
            reach = np.abs(arrays["places"]).max()
            raise ValueError(f"places reaches {reach:.3g}: expected pixels of a camera image of {shape}")
        for name, array in arrays.items():
            object.__setattr__(self, name, read_only(array))

    def __repr__(self) -> str:
        images = f"{self.n_images} camera image{'s' * (self.n_images > 1)} of {self.shape}"
        return f"Calibration(pupil of {self.diameter:.2f} pixels, {images}, residual={self.residual:.3g})"

    @classmethod
    def of(cls, measurement: Measurement, dark: ArrayLike | None = None, **settings: Any) -> Calibration:
        """Calibration of a measurement; pixels that are bad on its frames are ignored from then on.

        Parameters
        ----------
        measurement : Measurement
            Of frames that are taken as those to come, and of clear frames.
        dark : array_like, shape (ny, nx) or (n_images, ny, nx), counts, optional
            That was subtracted from the frames of the measurement; none if left out.
        **settings
            Attributes of the calibration: saturation, bunit, n_iterations, tolerance.

        Returns
        -------
        Calibration
        """
        _check.instance("measurement", measurement, Measurement)
        registered, pupil, good = measurement.registered, measurement.pupil, measurement.good
        images = registered.frames[: 1 if registered.frames[0] is registered.frames[1] else 2]
        shape = images[0].counts.shape
        if images[-1].counts.shape != shape:
            raise ValueError(f"the frames have shapes {shape} and {images[-1].counts.shape}: expected the same")
        counts, _ = registered._on_grid(FRAMES)
        unit, background = measurement.counts * registered.exposure, measurement.background[:2]
        inner = (..., *measurement.window)

        def undone(*light: float) -> NDArray[np.float64]:
            intensity = np.ones_like(measurement.intensity) * np.reshape(light, (2, 1, 1))
            return ideal_frames(replace(measurement, intensity=intensity))[inner]

        offset = undone(0, 0)
        made = cls(
            pupil.amplitude, pupil.n_pixels, pupil.center, measurement.optics, shape, len(images),
            registered.places()[:2], _dark(dark, (len(images), *shape)), np.stack([image.bad for image in images]),
            good, background / registered.areas[:2], unit / registered.areas[:2],
            np.stack([undone(1, 0) - offset, undone(0, 1) - offset], axis=1), offset,
            bool(registered.balance and measurement.optics.opposite),
            (counts[:, good].mean(axis=1) - background) / unit,
            np.zeros((0, *pupil.shape), np.float32), np.zeros(0), np.zeros((0, 2)), **settings,
        )  # fmt: skip
        frames = np.maximum(ideal_frames(measurement)[inner], 0)[np.newaxis].astype(np.float32)
        phase = made._work.solve(frames, good[np.newaxis]).phase
        errors = sideways(made.sensor, phase[0], frames[0], good)[np.newaxis]
        shift = made._work.displaced(phase, frames, good[np.newaxis])[0]
        made = replace(made, unexplained=errors, slopes=slopes_of(phase, good), displacements=shift)
        residual, ratio = made._work.compared(phase, frames, good[np.newaxis])
        return replace(made, residual=float(residual[0]), light_ratio=float(ratio[0]))

    @classmethod
    def from_bench(
        cls, fit: BenchFit, frames: ArrayLike, phases: ArrayLike, dark: ArrayLike | None = None, *,
        corners: ArrayLike = ((0, 0), (0, 0)), shape: tuple[int, int] | None = None, n_images: int = 2,
        **settings: Any,
    ) -> Calibration:  # fmt: skip
        """Calibration from a fit of the bench: its geometry, blur and leakage as linear operators.

        The focus of the relay is corrected to first order, around a flat wavefront.

        Parameters
        ----------
        fit : BenchFit
        frames : array_like, shape (n_states, 2, ny, nx) or (n_states, n_frames, 2, ny, nx), counts
            As for `fit_bench`: less the dark, NaN where bad.
        phases : array_like, shape (n_states, n, n), radian
            As for `fit_bench`. The phases of the calibration are on this grid.
        dark : array_like, shape (ny_camera, nx_camera) or (n_images, ny_camera, nx_camera), counts, optional
            That was subtracted from the frames; none if left out.
        corners, shape, n_images : array_like of int, shape (2, 2); (int, int); int
            If the frames were cut out: row and column of their first pixels on the camera, rows and columns of a
            camera image, and the number of these in an exposure.
        **settings
            Attributes of the calibration: saturation, bunit, n_iterations, tolerance.

        Returns
        -------
        Calibration

        Raises
        ------
        TypeError, ValueError
            If the fit is of a wrong type, or shapes do not belong together.
        """
        _check.instance("fit", fit, BenchFit)
        counts, phases = _check.real_array("frames", frames), _check.real_array("phases", phases)
        n_averaged = counts.shape[1] if counts.ndim == 5 else 1
        counts = counts.mean(axis=1) if counts.ndim == 5 else counts
        n = len(fit.light)
        frame = 2, *fit.point.problem.camera.shape
        if counts.shape[1:] != frame or phases.shape != (len(counts), n, n):
            expected = f"(n_states, {', '.join(map(str, frame))}) and (n_states, {n}, {n}), those of the fit"
            raise ValueError(
                f"frames and phases have shapes {counts.shape} and {phases.shape}: expected {expected}"
            )
        shape = counts.shape[2:] if shape is None else _check.pair("shape", shape, _check.integer, 1, _WIDEST)
        n_images = _check.integer("n_images", n_images, 1, 2)
        corners, most = _check.integer_array("corners", corners), np.subtract(shape, counts.shape[2:])
        if corners.shape != (2, 2) or np.any(corners < 0) or np.any(corners > most):
            raise ValueError(
                f"corners = {_check.shown(corners.tolist())}: expected two pairs of a row and a column, from "
                f"(0, 0) to {tuple(most.tolist())}, so that frames of {counts.shape[2:]} lie on one of {shape}"
            )

        def on_camera(pairs: NDArray) -> NDArray:
            whole = np.zeros((len(pairs), n_images, *shape))
            for index, (row, column) in enumerate(corners):
                place = slice(row, row + counts.shape[2]), slice(column, column + counts.shape[3])
                whole[(slice(None), min(index, n_images - 1), *place)] = pairs[:, index]
            return whole

        masks, arms = fit.point.model.masks, fit.point.model.arms[:2]
        optics = Optics(
            masks["diameter"],
            (masks["first"], masks["second"]),
            leakage=masks["leakage"],
            unmasked=max(masks["unmasked"], 0.0),
        )
        n_pixels, bad = fit.point.problem.camera.n_pixels, ~np.isfinite(counts).all(axis=0)
        light = fit.light * (radius((n, n), ((n - 1) / 2,) * 2) <= n_pixels / 2)
        pupil = Pupil.from_amplitude(np.sqrt(np.maximum(light, 0)), n_pixels, threshold=_FAINTEST)
        background, flux = (np.array([arm[key] for arm in arms]) for key in ("background", "flux"))
        made = cls(
            pupil.amplitude, n_pixels, pupil.center, optics, shape, n_images,
            places_of(arms, n, counts.shape[2:]) + corners[..., None, None],
            _dark(dark, (n_images, *shape)),
            on_camera(bad[np.newaxis])[0] > 0, pupil.inside, background, flux * light[pupil.inside].mean(),
            np.zeros((2, 2, n, n)), np.zeros((2, n, n)), False, np.ones(2), np.zeros((0, n, n), np.float32),
            np.zeros(0), np.zeros((0, 2)), blur=masks["blur"], n_averaged=n_averaged, commanded=True, **settings,
        )  # fmt: skip
        good = pupil.inside & ~made._work.touched(made._work.bad[np.newaxis])[0]

        def intensity(pairs: NDArray) -> NDArray:
            values = made._work.on_grid(on_camera(np.nan_to_num(pairs)) + made.dark, np.inf, good)[0]
            return values.reshape(len(values), 2, n, n) / made.unit[:, np.newaxis, np.newaxis]

        seen, ideal = training(fit, made.sensor)
        weights, offset = learnt(intensity(seen), ideal, optics)
        light = intensity(counts)[..., good].mean(axis=(0, 2))
        made = replace(made, good=good, weights=weights, offset=offset, light=light)
        images = on_camera(np.nan_to_num(counts)) + made.dark
        # The lamp is that of the calibration, so its light is known.
        measured = made(images if n_images == 2 else images[:, 0], light=1.0, saturation=np.inf)
        ideal = np.einsum("ijyx,kjyx->kiyx", weights, intensity(counts)) + offset
        _, ratios = made._work.compared(measured.filled, ideal, np.broadcast_to(good, measured.phase.shape))
        made = replace(made, light_ratio=float(ratios.mean()))
        return replace(
            made, unexplained=unexplained(measured.phase, phases), slopes=slopes_of(measured.filled, good),
            displacements=measured.displacement.astype(float), residual=float(np.nanmax(measured.residual)),
        )  # fmt: skip

    def save(self, path: str | Path) -> None:
        """Write the calibration as NPZ, in one step; the same calibration gives the same bytes.

        Raises
        ------
        TypeError, ValueError
            If the path is none, or names a file that is not a calibration.
        """
        path = path_of("path", path)
        if path.exists() and not (path.is_file() and _is_calibration(path)):
            raise ValueError(f"path = {str(path)!r} exists and is not a calibration: expected a new name")
        write_file(path, self._content)

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read a calibration that `save` wrote.

        Raises
        ------
        FileNotFoundError, TypeError, ValueError
            ValueError is a FileError if the file is broken, is not a calibration, or has another format.
        """
        path = path_of("path", path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file: expected a calibration")
        if not _is_calibration(path):
            raise FileError(f"{path.name}: expected a calibration, which `calibrate` writes")
        _check_sizes(path)
        with broken(f"{path.name}: a broken calibration"), np.load(path, allow_pickle=False) as file:
            values: dict[str, Any] = json.loads(str(file["values"]))
            found = values.pop("format")
            if found == FORMAT:
                values |= {name: file[name] for name in file.files if name != "values"}
                values |= {name: tuple(values[name]) for name in ("center", "shape")}
                shifts = {"phase_shifts": tuple(values["optics"]["phase_shifts"])}
                made = cls(**values | {"optics": Optics(**values["optics"] | shifts)})
                trial = made.dark + np.mean(made.background + made.unit * made.light)
                made(trial[0] if made.n_images == 1 else trial)
                return made
        raise FileError(f"{path.name}: a calibration of format {found}: expected format {FORMAT}; make it again")

    @cached_property
    def sha256(self) -> str:
        """Checksum of the file that `save` writes."""
        return hashlib.sha256(self._content).hexdigest()

    @property
    def sensor(self) -> ZernikeSensor:
        """Model of the sensor, on the grid of the pupil."""
        return self._work.reconstruct.sensor

    def __call__(
        self, counts: ArrayLike, start: NDArray | None = None, *, light: ArrayLike | None = None,
        saturation: float | None = None,
        largest_residual: float | None = None, judge: bool = True, method: Reconstructor | None = None,
    ) -> Phases:  # fmt: skip
        """Phases of camera images.

        Parameters
        ----------
        counts : array_like, shape (..., ny, nx), or (..., 2, ny, nx) where an exposure has two images
            As the camera gives them, of any real type, the dark included.
        start : ndarray, shape (ny, nx) or (..., ny, nx), radian, optional
            Phase at which the iteration starts, such as `filled` of the frames before; flat if left out.
        light : float or array_like, shape (...), optional
            Light relative to that of the calibration, such as `flux` of the frames before. By default the frames
            show it. This takes about 20 times as long if the light is another one and the phase is large.
        saturation : float, counts, optional
            Replaces that of the calibration.
        largest_residual : float, optional
            Residual above which a frame is inconsistent. By default it is 2.5 times the residual that the frames
            of the calibration would have with the light and the noise of this one.
        judge : bool
            Whether to compare the frames with their model. Without it residual and displacement are NaN, no frame
            is inconsistent or moved, and the light follows from the mean of the frames alone.
        method : Reconstructor, optional
            Replaces the phase-shifted iteration, such as ``zwfs.Linear(calibration.sensor, modes)``.

        Returns
        -------
        Phases
        """
        counts = _check.plain_array("counts", counts)
        if counts.dtype.kind not in "biuf":
            raise TypeError(f"counts has dtype {counts.dtype}: expected real numbers")
        image = self.shape if self.n_images == 1 else (2, *self.shape)
        _check.trailing_shape("counts", counts, image, "the camera image of the calibration")
        batch = counts.shape[: -len(image)]
        if 0 in counts.shape:
            raise ValueError(f"counts has shape {counts.shape}: expected at least one exposure")
        saturation = self.saturation if saturation is None else _number_or_inf("saturation", saturation)
        level, judge = min(saturation, _check.LARGEST), _check.flag("judge", judge)
        if largest_residual is not None:
            largest_residual = _number_or_inf("largest_residual", largest_residual)
        counts, grid = counts.reshape(-1, self.n_images, *self.shape), self.good.shape
        if start is not None:
            maps = _check.real_array("start", start)
            if maps.shape not in (grid, (*batch, *grid)):
                raise ValueError(f"start has shape {maps.shape}: expected {grid} or {(*batch, *grid)}")
            _check.moderate("start", maps)
            start = np.broadcast_to(maps, (*batch, *grid)).reshape(-1, *grid)
        if method is not None:
            _check.instance("method", method, Reconstructor)
            if method.sensor is not self.sensor:
                raise ValueError("method has another sensor: expected `sensor` of this calibration")
            if start is not None and not method.iterative:
                raise ValueError(f"start with method = {method!r}: expected none, because it does not iterate")
        if light is not None:
            lights = _check.real_array("light", light)
            if lights.shape not in ((), batch) or not np.all((lights > 0) & (lights < np.inf)):
                raise ValueError(
                    f"light = {_check.shown(lights.tolist())}: expected finite numbers above 0, one or {batch}"
                )
            light = np.broadcast_to(lights, batch).reshape(-1)
        parts = []
        for first in range(0, len(counts), _PIECE):
            piece = slice(first, first + _PIECE)
            begin, known = (None if one is None else one[piece] for one in (start, light))
            parts.append(self._phases(counts[piece], begin, known, level, largest_residual, judge, method))
        return Phases._joined(parts, batch)

    def controller(
        self, flat: ArrayLike | str | Path, pushed: ArrayLike | str | Path, pulled: ArrayLike | str | Path,
        **settings: Any,
    ) -> Controller | PhaseController:  # fmt: skip
        """Return what turns camera counts into commands of a mirror, from frames of pokes of its actuators.

        Only this method needs the pokes; the mirror and its modes follow from them: actuators, or piston, tip and
        tilt of segments.

        Parameters
        ----------
        flat : array_like, shape (..., ny, nx) or (..., 2, ny, nx), counts, or path
            Frames of the shape that the loop holds, the dark included; leading axes are averaged.
        pushed, pulled : array_like, shape (n_commands, ..., ny, nx), counts, or path
            Frames with each command at `poke` and at -`poke` from there. Axes after the first are averaged.
        **settings
            poke : float, 1 by default
                Size of the pokes, in units of the commands.
            rcond : float, 0.05 by default
                Directions of the commands are left out that are weaker than this, relative to the strongest.
            gain : float, 0.5 by default
                Of the integrator, in (0, 2].
            method : {"linear", "phase-shifted", "likelihood"}
                By default the linear `Controller`. The others return a `PhaseController`.
            n_iterations : int, 3 by default
                Of each frame, of the phase-shifted iteration.

        Returns
        -------
        Controller or PhaseController

        Raises
        ------
        FileNotFoundError, TypeError, ValueError
            If frames are of a wrong type or shape. If pokes do not move the frames, push and pull of one
            contradict each other, or two move the frames in the same way: the message names them, from 0.
        """
        return make_controller(self, flat, pushed, pulled, **settings)

    def modal_matrix(self, modes: ArrayLike) -> NDArray[np.float64]:
        """Matrix that fits modes to a phase: least squares over the good points, without the piston.

        Parameters
        ----------
        modes : array_like, shape (n_modes, ny, nx)
            On the grid of the pupil.

        Returns
        -------
        ndarray, shape (n_points, n_modes)
            `coefficients` multiplies the phases of the points of the pupil by it.

        Raises
        ------
        TypeError, ValueError
            If the modes are of the wrong kind or shape, or not independent on the good points.
        """
        values = _check.modes("modes", modes, self.sensor.pupil)
        good = self.sensor.pupil.gather(self.good)
        centred = values[:, good] - values[:, good].mean(axis=1, keepdims=True)
        _check.independent("modes", centred, " on the good points")
        matrix = np.zeros((good.size, len(values)))
        matrix[good] = np.linalg.pinv(centred)
        return matrix

    def coefficients(self, phases: Phases, matrix: NDArray) -> NDArray[np.float32]:
        """Coefficients of modes, (..., n_modes), radian, by one product with a `modal_matrix`."""
        _check.instance("phases", phases, Phases)
        matrix = _check.real_array("matrix", matrix)
        _check.moderate("matrix", matrix)
        if matrix.ndim != 2 or len(matrix) != self.sensor.pupil.n_points:
            raise ValueError(f"matrix has shape {matrix.shape}: expected ({self.sensor.pupil.n_points}, n_modes)")
        values = without_piston(self.sensor.pupil.gather(phases.filled))
        with np.errstate(over="ignore", invalid="ignore"):
            coefficients = values @ matrix.astype(values.dtype, copy=False)
        _check.finite("the product of phases and matrix", coefficients)
        return coefficients

    def sigma(
        self, phases: Phases, photons: float, read_noise: float = 0.0, modes: ArrayLike | None = None
    ) -> NDArray[np.float32]:
        """Standard error: the Cramer-Rao bound of noise at each phase, and the errors of the calibration's phases.

        At 0.5 rad rms and 1.06 lambda/D the phase-shifted iteration is 6 % above the bound. Errors that all states
        of a calibration share are not part of it. It takes longer than the phases.

        Parameters
        ----------
        phases : Phases
        photons : float
            That an intensity of 1 puts into a pixel: `unit` times the electrons per count.
        read_noise : float, electrons rms / pixel
        modes : array_like, shape (n_modes, ny, nx), optional
            Modes that make up the phase, as for `cramer_rao`; the phases of all points if left out.

        Returns
        -------
        ndarray, shape (..., ny, nx) or (..., n_modes), radian
            NaN outside the pupil, at bad points and for lost frames.
        """
        _check.instance("phases", phases, Phases)
        photons = _check.number("photons", photons, 1e-6, 1e12)
        pupil, model = self.sensor.pupil, propagator(self.sensor, Kind.numpy())
        basis = None if modes is None else pupil.scatter(_check.modes("modes", modes, pupil), fill=0)
        estimator = Estimator(
            self._work.response, Noise.checked(photons, read_noise, self.sensor.recorded), False, basis
        )

        def variance(phase: NDArray) -> NDArray:
            psi = split(phase[np.newaxis], model.amplitude)
            points, of_modes = estimator.variance(psi, model.propagate(psi))
            return points[0, 0] if of_modes is None else of_modes[0]

        noise, errors = variance(np.zeros(pupil.shape)) / self.n_averaged, self.unexplained.astype(float)
        if basis is not None:
            errors = pupil.gather(errors) @ self.modal_matrix(basis)
        more = Excess.of(errors, noise, self.slopes, self.good, basis is not None)
        maps = phases.filled.reshape(-1, *pupil.shape).astype(np.float64)
        result = np.full((len(maps), *noise.shape), np.nan, np.float32)
        for index in np.flatnonzero(phases.flags.reshape(-1) & Flag.LOST == 0):
            result[index] = np.sqrt(variance(maps[index]) + more.at(maps[index], self.good))
        result = result.reshape((*phases.flags.shape, *noise.shape))
        return result if basis is not None else np.where(np.isfinite(phases.phase), result, np.float32(np.nan))

    @cached_property
    def _content(self) -> bytes:
        plain = {one.name: getattr(self, one.name) for one in fields(self)}
        arrays: dict[str, Any] = {name: value for name, value in plain.items() if isinstance(value, np.ndarray)}
        values = {name: value for name, value in plain.items() if name not in arrays}
        values |= {"format": FORMAT, "optics": asdict(self.optics)}
        stream = io.BytesIO()
        np.savez(stream, values=np.array(json.dumps(values, sort_keys=True)), **arrays)
        return stream.getvalue()

    @cached_property
    def _work(self) -> Grid:
        return Grid(self)

    def _phases(
        self, counts: NDArray, start: NDArray | None, light: NDArray | None, level: float, limit: float | None,
        judge: bool, method: Reconstructor | None,
    ) -> Phases:  # fmt: skip
        """Phases of camera images, (k, n_images, ny_camera, nx_camera)."""
        work, k = self._work, len(counts)
        values, good, n_bad, n_saturated = work.on_grid(counts, level, self.good)
        n_good = np.maximum(np.count_nonzero(good, axis=(1, 2)), 1)
        flux = np.vecdot(values, good.reshape(k, 1, -1).astype(np.float32)) / (n_good[:, np.newaxis] * self.unit)
        relative, noise = flux.mean(axis=1) / self.light.mean(), self._noise(counts, flux)
        lit = np.all((flux >= _DIM * self.light) | (flux > noise), axis=1)
        lit &= n_good >= (1 - _MOST_BAD) * self.sensor.pupil.n_points
        flux = np.where(lit[:, np.newaxis], flux, self.light)
        if self.balance:
            values *= (flux.mean(axis=1, keepdims=True) / flux).astype(np.float32)[..., np.newaxis]
        values /= self.unit[:, np.newaxis].astype(np.float32)
        values = values.reshape(k, *self.offset.shape)
        ideal = work.weights[:, 0] * values[:, :1] + work.weights[:, 1] * values[:, 1:]

        def attempt(which: NDArray[np.intp], light: NDArray[np.float64]) -> Trial:
            frames = ideal[which] / light[:, np.newaxis, np.newaxis, np.newaxis].astype(np.float32) + work.offset
            frames[~lit[which]] = work.flat_frames  # of a flat wavefront: they converge at once
            if method is None:
                np.maximum(frames, 0, out=frames)
            begin = None if start is None else start[which]
            solved = work.solve(frames, good[which], begin, method)
            residual, ratio = np.full((2, len(which)), np.nan)
            if judge:
                residual, ratio = work.compared(solved.phase, frames, good[which])
            ratio, usual = ratio / self.light_ratio, self._usual(light, noise[which])
            unsure = np.hypot(_SAME_LIGHT, 2 * usual / np.sqrt(n_good[which]))
            cost = np.where(lit[which], (residual / usual) ** 2 + ((ratio - 1) / unsure) ** 2, 0)
            return Trial(light, solved.phase, frames, *solved[1:], residual, ratio, cost)

        same = (relative > _LAMP[0]) & (relative < _LAMP[1]) | ~lit
        first = np.where(same, 1.0, relative) if light is None else light
        trial = attempt(np.arange(k), first)
        if light is None and judge:
            trial = explained(attempt, trial)
        residual, displacement, sigma = (np.full((k, *size), np.nan, np.float32) for size in ((), (2,), (2,)))
        if judge and lit.any():
            residual[lit] = trial.residual[lit]
            shift, sigma[lit] = work.displaced(trial.phase[lit], trial.frames[lit], good[lit])
            displacement[lit] = shift - (self.displacements.mean(axis=0) if len(self.displacements) else 0)
        limits = _UNUSUAL * self._usual(trial.light, noise) if limit is None else limit
        flags = _BAD * (n_bad > 0) + _SATURATED * (n_saturated > 0) + _INCONSISTENT * (residual > limits)
        flags += np.where(lit, _NOT_CONVERGED * (~trial.converged & (self.tolerance > 0)), _LOST)
        scatter = self.displacements.std(axis=0) if len(self.displacements) else 0
        moved = np.abs(displacement) > np.maximum(_MOVED_BY, _SURE * np.hypot(sigma, scatter))
        flags += _MOVED * np.any(moved, axis=1)
        phase = np.where(good & lit[:, np.newaxis, np.newaxis], trial.phase, np.float32(np.nan))
        flux = np.where(lit, trial.light, relative).astype(np.float32)
        numbers = residual, displacement, trial.n_iterations, flags
        return Phases(phase, trial.phase, flux, n_bad, n_saturated, *numbers)

    def _noise(self, counts: NDArray, flux: NDArray) -> NDArray[np.float64]:
        """Noise of dark pixels over `unit`, (k, 2), of exposures so faint that it counts; else 0."""
        noise, faint = np.zeros(flux.shape), np.flatnonzero(np.any(flux < _FAINT * self.light, axis=1))
        if faint.size:
            noise[faint] = self._work.noise(counts[faint]) / self.unit
        return noise

    def _usual(self, light: NDArray, noise: NDArray) -> NDArray[np.float64]:
        """Residual, (k,), that frames of the calibration would have with less light and with a noise, (k, 2)."""
        scale = np.maximum(light, 1e-9)
        own = max(self.residual, _EXACT) * np.sqrt(np.maximum(1 / scale, 1))
        return np.hypot(own, np.sqrt(np.mean(noise**2, axis=1)) / scale)


def _is_calibration(path: Path) -> bool:
    """Whether a file is an NPZ file with the values of a calibration."""
    try:
        with zipfile.ZipFile(path) as file:
            return {"values.npy", "places.npy"} <= set(file.namelist())
    except Exception:  # zipfile raises many kinds on damaged bytes
        return False


def _check_sizes(path: Path) -> None:
    """Require that the arrays of an NPZ file, by their shapes, are no larger than the file."""
    size = path.stat().st_size
    with broken(f"{path.name}: a broken calibration"), zipfile.ZipFile(path) as file:
        for name in file.namelist():
            with file.open(name) as member:
                np.lib.format.read_magic(member)
                shape, _, dtype = np.lib.format.read_array_header_1_0(member)
            if math.prod(shape) * dtype.itemsize > size:
                raise FileError(
                    f"{path.name}: its array {name} has shape {shape} and type {dtype}: expected at most the "
                    f"{size} bytes of the file"
                )


def _number_or_inf(name: str, value: Any, *, open_low: bool = False) -> float:
    """Return a number of at least 0, or infinity."""
    is_inf = isinstance(value, float) and value == np.inf
    return value if is_inf else _check.number(name, value, 0, _check.LARGEST, open_low=open_low)


def _dark(dark: ArrayLike | None, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Checked counts without light, one map for each camera image."""
    maps = np.zeros(shape) if dark is None else _check.real_array("dark", dark)
    if maps.shape not in (shape[1:], (1, *shape[1:]), shape):
        raise ValueError(f"dark has shape {maps.shape}: expected {shape}")
    return np.broadcast_to(np.nan_to_num(maps, posinf=0, neginf=0).astype(np.float32), shape)
