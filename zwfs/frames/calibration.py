"""A calibrated bench: what is computed once, so that camera images become phases in one call.

`Calibration.from_files` makes it from camera files, `Calibration.from_arrays` from arrays of frames and clear
frames, `Calibration.fit` from frames of a mirror in known states, and `Calibration.of` from a measurement that was
registered and reduced step by step.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import warnings
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Immutable, Kind, read_only
from zwfs._likelihood import Estimator, Noise
from zwfs._propagator import propagator, split
from zwfs._system import path_of, write_file
from zwfs.frames._blocks import FileError, broken
from zwfs.frames._errors import Excess, sideways, slopes_of
from zwfs.frames._exposures import SURE, Exposures
from zwfs.frames._fit import BenchFit, fit_bench
from zwfs.frames._fitted import WIDEST, smooth_phases
from zwfs.frames._follow import checked_follow, followed
from zwfs.frames._grid import Grid
from zwfs.frames._learnt import of_bench
from zwfs.frames._prediction import Prediction
from zwfs.frames._solver import MapPrior
from zwfs.frames.controller import Controller, PhaseController, make_controller
from zwfs.frames.phases import Flag, Phases
from zwfs.frames.pipeline import Measurement, Optics, doubt, ideal_frames, measured
from zwfs.frames.registration import FRAMES
from zwfs.metrics import without_piston
from zwfs.reconstructors.base import Reconstructor
from zwfs.sensor import ZernikeSensor

FORMAT = 2  # of the file; another number is refused
_RANGES = (
    ("n_iterations", 1, math.inf), ("tolerance", 0, 2 * np.pi), ("residual", 0, math.inf), ("blur", 0, 10),
    ("light_ratio", 0, math.inf), ("n_averaged", 1, math.inf), ("n_images", 1, 2), ("diameter", 1, math.inf),
)  # fmt: skip
_OF_BENCH = "bench_"  # first letters of the names of its arrays in a file
_APART = 0.35  # pixels between the pupils on frames and clear frames that are worth a word
_PIECE = 8  # exposures that are handled together: more do not fit the fast memory of a processor


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Immutable):
    """Sensor and camera of a bench: called on camera images, it returns their phases.

    Make one with `from_files`, `from_arrays`, `fit`, `of` or `load`. It cannot be changed. Its pickle is small,
    and the model of the sensor is made at the first call of each process.

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
    around : ndarray, shape (2,)
        Background of the calibration's frames, as that of `Phases`, to which that of other frames is compared.
    residual : float
        Rms difference of the calibration's frames and their model, the largest of all states, as in `Phases`.
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
    bench : BenchFit or None
        Optics that were fitted to known commands.
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
    around: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    residual: float = 0.0
    light_ratio: float = 1.0
    saturation: float = np.inf
    blur: float = 0.0
    n_averaged: int = 1
    commanded: bool = False
    bunit: str = ""
    n_iterations: int = 25
    tolerance: float = 1e-3
    bench: BenchFit | None = None

    def __post_init__(self) -> None:
        _check.declared(self)
        for name, low, high in _RANGES:
            _check.number(name, getattr(self, name), low, high, open_low=name == "light_ratio")
        _check.number_or_inf("saturation", self.saturation, open_low=True)
        shape = _check.pair("shape", self.shape, _check.integer, 1, WIDEST)
        grid, camera = _check.real_map("amplitude", self.amplitude).shape, (self.n_images, *shape)
        n_states = self.slopes.size
        sizes: dict[str, tuple[int, ...]] = {
            "amplitude": grid, "good": grid, "bad": camera, "places": (2, 2, *grid),
            "dark": camera, "background": (2,), "unit": (2,), "weights": (2, 2, *grid), "offset": (2, *grid),
            "light": (2,), "unexplained": (n_states, *grid), "slopes": (n_states,), "displacements": (n_states, 2),
            "around": (2,),
        }  # fmt: skip
        for name, size in sizes.items():
            array = getattr(self, name)
            if array.shape != size:
                raise ValueError(f"{name} has shape {array.shape}: expected {size}")
            _check.finite(name, array)
            if name in ("unit", "light") and np.any(array <= 0):
                raise ValueError(f"{name} = {_check.shown(array)}: expected values above 0")
            object.__setattr__(self, name, read_only(array))
        _check.non_negative("amplitude", self.amplitude)
        if self.bench is not None and any(
            size > most for size, most in zip(self.bench.model.shape, shape, strict=True)
        ):
            raise ValueError(f"bench has frames of {self.bench.model.shape}: expected at most {shape}")
        if not np.any(self.good & (self.amplitude > 0)):
            raise ValueError("amplitude is 0 at all good points: expected light at some")
        if np.any(np.abs(self.places) > 2 * max(shape)):  # the work grows with the distance
            reach = np.abs(self.places).max()
            raise ValueError(f"places reaches {reach:.3g}: expected pixels of a camera image of {shape}")

    def __repr__(self) -> str:
        images = f"{self.n_images} camera image{'s' * (self.n_images > 1)} of {self.shape}"
        return f"Calibration(pupil of {self.diameter:.2f} pixels, {images}, residual={self.residual:.3g})"

    @classmethod
    def from_files(
        cls, frame_files: Sequence[str | Path], pupil_files: Sequence[str | Path],
        dark_files: Sequence[str | Path] = (), bad_pixel_files: Sequence[str | Path] = (), *,
        diameter: float = 0.0, phase_shifts: Sequence[float] = (), saturation: float | None = None,
        fitted: Sequence[str] = (),
        commands: str | Path | None = None, noise: float | None = None, gain: float = 1.0, n_iterations: int = 25,
        tolerance: float = 1e-3, pupil_dark_files: Sequence[str | Path] = (), n_images: int | None = None,
        progress: Callable[[str], Any] | None = None, **settings: Any,
    ) -> Calibration:  # fmt: skip
        """Calibration from camera files: frames as those to come, and clear frames.

        With known commands of a mirror, `fit` fits a model of the camera to the frames, which takes minutes. Of
        three states or more, the last is first left out: if a fit to the others measures it worse than a
        calibration without commands, a warning says so, and the latter is returned.

        Parameters
        ----------
        frame_files, pupil_files, dark_files, bad_pixel_files : sequence of str or Path
            See `zwfs.frames.files.read_all`.
        diameter, phase_shifts : float, lambda/D, and sequence of one or two floats, radian
            Of the dimple; DIMPLE, THETA1 and THETA2 of the header if 0 and empty. With one, there is one image.
        saturation : float, counts, optional
            Of the camera, see `zwfs.frames.files.read_all`. By default the limit of the frames to come is SATURATE
            of the header, or the largest number of their type.
        fitted : sequence of str
            Parameters that `zwfs.frames.refine.fit` fits to these frames.
        commands : str or Path, optional
            File with known phases (n_states, n, n), radian, as for `fit`. Then the files of frames hold one or
            more exposures of each state in turn, (n, ny, nx) or (n, 2, ny, nx). Clear frames may be such a cube.
        noise, gain : float, counts rms and electrons / count
            As for `fit`.
        n_iterations, tolerance : int and float, radian
        pupil_dark_files, n_images : sequence of str or Path, and int, optional
            See `zwfs.frames.files.read_all`.
        progress : callable, optional
            With commands, called with a short text before each step of the fit.
        **settings
            Of `zwfs.frames.registration.register_frames`: pupil_centers, pupil_diameter, exposure, subpixel. With
            commands only the first two. By default the exposure is the ratio of the times that the headers state,
            see `zwfs.frames.files.read_all`, or 1.

        Raises
        ------
        FileNotFoundError, ImportError, TypeError, ValueError
            If a file or a value is not as expected, or astropy is needed and missing.

        Examples
        --------
        >>> import tempfile
        >>> from zwfs.bench import Bench, write_bench
        >>> from zwfs.frames import Calibration
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     files = write_bench(folder, Bench(n_pixels=40), seed=1)
        ...     calibration = Calibration.from_files([files["frame"]], [files["pupils"]], [files["dark"]])
        ...
        >>> calibration.optics.diameter, round(calibration.diameter)
        (1.06, 40)
        """
        from zwfs.frames._calibrate import Source  # late: it makes calibrations

        progress = _check.callback("progress", progress)
        gain = _check.number("gain", gain, 0, open_low=True)
        noise = None if noise is None else _check.number("noise", noise, 0, open_low=True)
        diameter = _check.number("diameter", diameter, 0)
        _check.sequence("phase_shifts", phase_shifts, expected="a list of one or two numbers")
        if n_images is not None:
            n_images = _check.integer("n_images", n_images, 1, 2)
        files = frame_files, pupil_files, dark_files, bad_pixel_files, pupil_dark_files
        attributes = {"n_iterations": n_iterations, "tolerance": tolerance}
        source = Source(files, diameter, tuple(phase_shifts), saturation, n_images, settings, attributes)
        if commands is None:
            return source.registered(fitted)
        if fitted:
            raise ValueError(
                f"fitted = {_check.shown(fitted)}: expected none with commands, which fit all of them"
            )
        return source.commanded(path_of("commands", commands), noise=noise, gain=gain, progress=progress)

    @classmethod
    def from_arrays(
        cls, frames: ArrayLike, clear_frames: ArrayLike, dark: ArrayLike | None = None, *,
        saturation: float = np.inf, exposure: float = 1.0, n_iterations: int = 25, tolerance: float = 1e-3,
        **optics: Any,
    ) -> Calibration:  # fmt: skip
        """Calibration from a pair of frames as those to come, and from clear frames.

        Parameters
        ----------
        frames, clear_frames : array_like, shape (ny, nx) or (2, ny, nx), counts
            One camera image with both pupils, or one for each: with the mask in, and with the mask out. With one
            phase shift, one image with one pupil. NaN, or the mask of a masked array, marks bad pixels. Average
            several exposures first.
        dark : array_like, shape (ny, nx) or (2, ny, nx), counts, optional
            Counts without light, which are subtracted from both, and from the frames to come.
        saturation, n_iterations, tolerance : float, counts; int; float, radian
            Attributes of the calibration. Pixels that reach the saturation are bad, the dark included.
        exposure : float
            Exposure of the frames over that of the clear frames.
        **optics
            Parameters of `Optics`, such as `diameter` and `phase_shifts`, or `masks`.

        Raises
        ------
        TypeError, ValueError
            If a shape is wrong, or the pupils are not found.
        """
        attributes = {"saturation": saturation, "n_iterations": n_iterations, "tolerance": tolerance}
        measurement = measured(frames, clear_frames, dark, Optics(**optics), saturation, exposure)
        return cls.of(measurement, **attributes)

    @classmethod
    def fit(
        cls, frames: ArrayLike, clear_frames: ArrayLike, phases: ArrayLike, *, n_pixels: float,
        noise: float | None = None, gain: float = 1.0, diameter: float = 1.06,
        phase_shifts: tuple[float, float] = (np.pi / 2, -np.pi / 2), oversampling: int | None = None,
        n_steps: int = 15, progress: Callable[[str], Any] | None = None, **settings: Any,
    ) -> Calibration:  # fmt: skip
        """Calibration from frames of a mirror in known states: a fit of the bench, and linear operators of it.

        The fit is `bench` of the result: read its `consistent` and `remarks`. The operators hold geometry, blur
        and leakage, and the focus of the relay to first order. A call corrects their phases twice with all of the
        fit, which takes milliseconds. With `smooth`, it fits each exposure, in seconds.

        Parameters
        ----------
        frames : array_like, shape (n_states, 2, ny, nx) or (n_states, n_frames, 2, ny, nx), counts
            Windows around the two pupils, less the dark. NaN marks bad pixels. Several frames are averaged.
        clear_frames : array_like, shape (2, ny, nx) or (n_frames, 2, ny, nx), counts
            Less the dark, with the mask out.
        phases : array_like, shape (n_states, n, n), radian
            Phases that the commands add, mean over each pixel, on a grid whose middle is that of the frames. The
            phases of the calibration are on this grid. NaN, or 0 in all states, marks what is unknown around the
            pupil; there the phases are continued.
        n_pixels : float, pixels
            Diameter D.
        noise : float, counts rms, optional
            Of a pixel of one frame without light: read noise, and that of the background and the dark. By default
            it is estimated from the darkest pixels; `bench` names it.
        gain : float, electrons / count
            For the photon noise.
        diameter : float, lambda/D
            Of the dimple, by design. The fit starts from the best of several diameters around it.
        phase_shifts : (float, float), radian
            Of the two images, by design. The fit tries both orders, and a remark reports a reversed one.
        oversampling : int, optional
            Points of the model along a pixel. By default 2, and if the misfit is above 1 with them, the fit goes
            on with 3: light at vanes and gaps needs the finer grid.
        n_steps : int
            Largest number of steps of each stage.
        progress : callable, optional
            Called with a short text before each step.
        **settings
            Attributes of the calibration: saturation, bunit, n_iterations, tolerance.

        Raises
        ------
        TypeError, ValueError
            If shapes do not belong together, there are fewer than two states, or a clear frame holds no light.
        """
        bench = fit_bench(
            frames, clear_frames, phases, n_pixels=n_pixels, noise=noise, gain=gain, diameter=diameter,
            phase_shifts=phase_shifts, oversampling=oversampling, n_steps=n_steps, progress=progress,
        )  # fmt: skip
        counts = _check.real_array("frames", frames)
        return of_bench(cls, bench, counts, _check.real_array("phases", phases), **settings)

    @classmethod
    def of(cls, measurement: Measurement, **settings: Any) -> Calibration:
        """Calibration of a measurement; pixels that are bad on its frames are ignored from then on.

        Parameters
        ----------
        measurement : Measurement
            Of frames that are taken as those to come, and of clear frames. Its images know the dark. If no phase
            explains them, or the pupil has moved between frames and clear frames, there is a warning.
        **settings
            Attributes of the calibration: saturation, bunit, n_iterations, tolerance.
        """
        _check.instance("measurement", measurement, Measurement)
        registered, pupil, good = measurement.registered, measurement.pupil, measurement.good
        images = registered.camera_images
        shape = images[0].counts.shape
        if images[-1].counts.shape != shape:
            raise ValueError(f"the frames have shapes {shape} and {images[-1].counts.shape}: expected the same")
        dark = np.nan_to_num([image.dark for image in images], posinf=0, neginf=0).astype(np.float32)
        counts, _ = registered._on_grid(FRAMES)
        unit, background = measurement.counts * registered.exposure, measurement.background[:2]
        weights, offset = _undone(measurement)
        calibration = cls(
            pupil.amplitude, pupil.n_pixels, pupil.center, measurement.optics, shape, len(images),
            registered.places()[:2], dark, np.stack([image.bad for image in images]),
            good, background / registered.areas[:2], unit / registered.areas[:2], weights, offset,
            bool(registered.balance and measurement.optics.opposite),
            (counts[:, good].mean(axis=1) - background) / unit,
            np.zeros((0, *pupil.shape), np.float32), np.zeros(0), np.zeros((0, 2)), **settings,
        )  # fmt: skip
        inner = (..., *measurement.window)
        frames = np.maximum(ideal_frames(measurement)[inner], 0)[np.newaxis].astype(np.float32)
        phase = calibration._work.solve(frames, good[np.newaxis]).phase
        errors = sideways(calibration.sensor, phase[0], frames[0], good)[np.newaxis]
        work, steady = calibration._work, calibration._work.steady(phase)
        shift = work.displaced(steady, frames, good[np.newaxis])[0]
        residual, ratio = work.compared(phase, frames, good[np.newaxis])
        exposure = np.stack([image.counts for image in images])[np.newaxis] + dark
        level, error = work.background(work.cleaned(exposure, np.inf, good)[0], steady, calibration.unit)
        around = np.where(np.abs(level) > SURE * error, level, 0)[0, 0]
        if remark := doubt(measurement, phase[0]):
            warnings.warn(remark, stacklevel=3)
        # In one image a phase at the edge looks like a shift.
        if np.abs(shift).max() > _APART and not measurement.optics.single:
            row, column = shift[0]
            warnings.warn(
                f"The pupil on the frames is off its place on the clear frames, by {row:+.1f} rows and "
                f"{column:+.1f} columns or more: expected the same place; look at the windows on the detector "
                "(DETSEC of a header)",
                stacklevel=3,
            )
        return replace(
            calibration, unexplained=errors, slopes=slopes_of(phase, good), displacements=shift,
            around=around, residual=float(residual[0]), light_ratio=float(ratio[0]),
        )  # fmt: skip

    def save(self, path: str | Path) -> None:
        """Write the calibration as NPZ, in one step; the same calibration gives the same bytes.

        Raises
        ------
        TypeError, ValueError
            If the path is none, or names a file that is not a calibration, or the optics have `masks`.
        """
        path = path_of("path", path)
        if self.optics.masks:
            raise ValueError("optics.masks are objects: expected dimples of one diameter, which a file can hold")
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
            file_format = values.pop("format")
            if file_format == FORMAT:
                bench = {name for name in file.files if name.startswith(_OF_BENCH)}
                values |= {name: file[name] for name in set(file.files) - bench - {"values"}}
                if bench:
                    maps = {name.removeprefix(_OF_BENCH): file[name] for name in bench}
                    values["bench"] = BenchFit.unpacked(values["bench"], maps)
                values |= {name: tuple(values[name]) for name in ("center", "shape")}
                shifts = {"phase_shifts": tuple(values["optics"]["phase_shifts"])}
                calibration = cls(**values | {"optics": Optics(**values["optics"] | shifts)})
                trial = calibration.dark + np.mean(calibration.background + calibration.unit * calibration.light)
                calibration(trial[0] if calibration.n_images == 1 else trial)
                return calibration
        raise FileError(
            f"{path.name}: a calibration of format {file_format}: expected format {FORMAT}; make it again"
        )

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
        smooth: bool | MapPrior = False, noise: ArrayLike | None = None, follow: bool = False,
    ) -> Phases:  # fmt: skip
        """Phases of camera images.

        With a `bench`, the fit predicts the frames of each phase, and what they miss corrects it. With `smooth`, a
        smooth prior is added, and each exposure is fitted, in seconds. Then the light is taken to be that of the
        calibration.

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
            of the calibration would have with the light and the noise of this one. With a `bench` it is 1.4 times
            the noise of this frame, the residual of the calibration or 0.0025, whichever is largest.
        judge : bool
            Whether to compare the frames with their model. Without it residual, displacement and background are
            NaN, no frame is inconsistent or moved, and the light follows from the mean of the frames alone.
        method : Reconstructor, optional
            Replaces the phase-shifted iteration, such as ``zwfs.Linear(calibration.sensor, modes)``. With a
            `bench`, its frames are those of the last correction.
        smooth : bool or MapPrior
            Whether phases are taken to be smooth, for a calibration with a `bench`. True lets the evidence of each
            exposure choose the prior: the probability of the frames with all its phases. On a pupil with gaps it
            may jump between segments, by a piston, a tip and a tilt of each, if the pupil has less than about 3000
            pixels. An item of `priors` of earlier phases saves half of the time, and fits phases of the same
            roughness and strength only.
        noise : float or array_like, shape (ny, nx) or (n_images, ny, nx), counts rms, optional
            Of the pixels, with `smooth`. By default it follows from the counts, and from gain and noise of the
            `bench`; that of means of several frames is smaller.
        follow : bool
            Whether images that have moved since the calibration by 0.1 to 3 pixels, both by the same rows and
            columns, are moved back and reconstructed again, at most three times. Bad pixels and the dark stay in
            place. Where this lowers the residual by less than a fifth, the images are not moved, and `MOVED` may
            stay. An exposure that has moved takes 0.1 s with a pupil of 40 pixels, and 0.5 s with one of 90.
        """
        counts = _check.plain_array("counts", counts)
        if counts.dtype.kind not in "biuf":
            raise TypeError(f"counts has dtype {counts.dtype}: expected real numbers")
        image = self.shape if self.n_images == 1 else (2, *self.shape)
        _check.trailing_shape("counts", counts, image, "the camera image of the calibration")
        batch = counts.shape[: -len(image)]
        if 0 in counts.shape:
            raise ValueError(f"counts has shape {counts.shape}: expected at least one exposure")
        saturation = self.saturation if saturation is None else _check.number_or_inf("saturation", saturation)
        level, judge = min(saturation, _check.LARGEST), _check.flag("judge", judge)
        if checked_follow(follow, self) and not judge:
            raise ValueError("follow = True with judge = False: expected judge = True, as it needs the residual")
        if largest_residual is not None:
            largest_residual = _check.number_or_inf("largest_residual", largest_residual)
        counts = counts.reshape(-1, self.n_images, *self.shape)
        if smooth is not False or noise is not None:
            options = {"start": start, "light": light, "largest_residual": largest_residual, "method": method}
            options["follow"] = follow or None
            for name, value in options.items():
                if value is not None:
                    raise ValueError(f"{name} with smooth or noise: expected none")
            return Phases._joined([smooth_phases(self, counts, level, smooth, noise)], batch)
        if start is not None:
            start = _spread_start(start, batch, self.good.shape)
        if light is not None:
            light = _spread_light(light, batch)
        if method is not None:
            _check.instance("method", method, Reconstructor)
            if method.sensor is not self.sensor:
                raise ValueError("method has another sensor: expected `sensor` of this calibration")
            if start is not None and not method.iterative:
                raise ValueError(f"start with method = {method!r}: expected none, because it does not iterate")
        parts = []
        for first in range(0, len(counts), _PIECE):
            piece = slice(first, first + _PIECE)
            begin, lamp = (None if values is None else values[piece] for values in (start, light))
            exposures = Exposures(self, counts[piece], level, begin, method, judge)
            limits = lamp, largest_residual
            parts.append(followed(exposures, *limits) if follow else exposures.phases(*limits))
        return Phases._joined(parts, batch)

    def controller(
        self, flat: ArrayLike | str | Path, pushed: ArrayLike | str | Path, pulled: ArrayLike | str | Path,
        **settings: Any,
    ) -> Controller | PhaseController:  # fmt: skip
        """Return a controller that converts camera counts into mirror commands, from frames of pokes.

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
                Relative singular value below which a combination of commands is left out.
            gain : float, 0.5 by default
                Of the integrator, in (0, 2].
            method : {"linear", "phase-shifted", "likelihood"}
                By default the linear `Controller`. The others return a `PhaseController`.
            n_iterations : int, 3 by default
                Of each frame, of the phase-shifted iteration.

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
        plain = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "bench"}
        arrays: dict[str, Any] = {name: value for name, value in plain.items() if isinstance(value, np.ndarray)}
        values = {name: value for name, value in plain.items() if name not in arrays}
        optics = {name: value for name, value in vars(self.optics).items() if name != "masks"}
        values |= {"format": FORMAT, "optics": optics}
        if self.optics.masks:
            values["masks"] = repr(self.optics.masks)
        if self.bench is not None:
            values["bench"], maps = self.bench.packed()
            arrays |= {_OF_BENCH + name: array for name, array in maps.items()}
        stream = io.BytesIO()
        np.savez(stream, values=np.array(json.dumps(values, sort_keys=True)), **arrays)
        return stream.getvalue()

    @cached_property
    def _work(self) -> Grid:
        return Grid(self)

    @cached_property
    def _prediction(self) -> Prediction | None:
        return Prediction(self, self.bench) if self.bench else None


def _undone(measurement: Measurement) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights and offset with which a measurement becomes frames of an ideal sensor, see `Calibration`."""

    def ideal(*light: float) -> NDArray[np.float64]:
        intensity = np.ones_like(measurement.intensity) * np.reshape(light, (2, 1, 1))
        return ideal_frames(replace(measurement, intensity=intensity))[(..., *measurement.window)]

    offset = ideal(0, 0)
    return np.stack([ideal(1, 0) - offset, ideal(0, 1) - offset], axis=1), offset


def _spread_start(start: ArrayLike, batch: tuple[int, ...], grid: tuple[int, ...]) -> NDArray[np.float64]:
    """Checked phases at which iterations start, (n, ny, nx)."""
    maps = _check.real_array("start", start)
    if maps.shape not in (grid, (*batch, *grid)):
        raise ValueError(f"start has shape {maps.shape}: expected {grid} or {(*batch, *grid)}")
    _check.moderate("start", maps)
    return np.broadcast_to(maps, (*batch, *grid)).reshape(-1, *grid)


def _spread_light(light: ArrayLike, batch: tuple[int, ...]) -> NDArray[np.float64]:
    """Checked light of exposures, (n,)."""
    lights = _check.real_array("light", light)
    if lights.shape not in ((), batch) or not np.all((lights > 0) & (lights < np.inf)):
        shown = _check.shown(lights.tolist())
        raise ValueError(f"light = {shown}: expected finite numbers above 0, one or {batch}")
    return np.broadcast_to(lights, batch).reshape(-1)


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
