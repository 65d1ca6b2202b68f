"""A second stage of adaptive optics: a screen that drifts, a sensor, an integrator and a mirror of modes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check, loop
from zwfs.detector import Detector
from zwfs.loop import Mirror
from zwfs.paper.linearity import check_reconstructors
from zwfs.pupil import Pupil

_BOX = 3.0  # D; the screens repeat after this length


class FrozenFlow:
    """Random screens that a wind carries across the pupil without a change of form.

    Each screen is a sum of plane waves on a square lattice of frequencies, with a power spectral density that
    falls as a power of the frequency. Moving it turns their phases, so it is moved by any distance exactly. It
    repeats after 3 D.

    Parameters
    ----------
    pupil : Pupil
    rms : float, radian
        Of every screen over the pupil at the start, piston removed.
    n_screens : int
        Each has another direction of the wind.
    speed : float, D / second
    cutoff : float, cycles / D
        Highest spatial frequency, at least 1 and at most one cycle per pixel.
    exponent : float
        Exponent of the power spectral density, in [-20, 20].
    seed : int, Generator or SeedSequence, optional

    Attributes
    ----------
    velocity : ndarray, shape (n_screens, 2), D / second
        Of each screen, along y and x.

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind or out of range.
    """

    def __init__(
        self,
        pupil: Pupil,
        rms: float,
        n_screens: int,
        *,
        speed: float = 2.5,
        cutoff: float = 5.0,
        exponent: float = -2.0,
        seed: int | np.random.Generator | np.random.SeedSequence | None = None,
    ) -> None:
        _check.instance("pupil", pupil, Pupil)
        rms = _check.number("rms", rms, 0)
        self.n_screens = _check.integer("n_screens", n_screens, 1)
        speed = _check.number("speed", speed, 0)
        cutoff = _check.number("cutoff", cutoff, 1, pupil.n_pixels)
        exponent = _check.number("exponent", exponent, -20, 20)
        self.pupil = pupil
        rng = _check.generator("seed", seed)
        n = int(cutoff * _BOX)
        u = np.arange(-n, n + 1) / _BOX  # frequencies along x, cycles / D
        v = u[:, np.newaxis]  # the same along y
        self._amplitudes = _random_amplitudes(np.hypot(u, v), cutoff, exponent, self.n_screens, rng)
        # A screen is the sum of a(v, u) exp(2 pi i (v y + u x)): two matrix products.
        self._waves_y = np.exp(2j * np.pi * np.outer(pupil.y, u))
        self._waves_x = np.exp(2j * np.pi * np.outer(u, pupil.x))
        # A wind (wy, wx) moves it to y - wy t, x - wx t: each amplitude turns by -2 pi (wy v + wx u) t.
        direction = rng.uniform(0, 2 * np.pi, self.n_screens)
        self.velocity = speed * np.stack([np.sin(direction), np.cos(direction)], axis=-1)
        wy, wx = self.velocity.T[..., np.newaxis, np.newaxis]
        self._turn = -2j * np.pi * (wy * v + wx * u)
        self._amplitudes *= (rms / pupil.rms(self(0.0)))[:, np.newaxis, np.newaxis]

    def __call__(self, time: float) -> NDArray[np.float64]:
        """Screens at a time in seconds, (n_screens, ny, nx), radian: without piston, 0 outside the pupil."""
        amplitudes = self._amplitudes * np.exp(self._turn * _check.number("time", time))
        inside = self.pupil.gather((self._waves_y @ amplitudes @ self._waves_x).real)
        return self.pupil.scatter(inside - inside.mean(axis=-1, keepdims=True), fill=0)


def _random_amplitudes(
    frequency: NDArray, cutoff: float, exponent: float, n_screens: int, rng: np.random.Generator
) -> NDArray[np.complex128]:
    """Gaussian amplitudes whose power falls as a power of the frequency; 0 for piston and beyond the cutoff."""
    used = (frequency > 0) & (frequency <= cutoff)
    scale = np.where(used, np.where(used, frequency, 1) ** (exponent / 2), 0)
    real, imaginary = rng.standard_normal((2, n_screens, *frequency.shape))
    return scale * (real + 1j * imaginary)


@dataclass(frozen=True)
class LoopRun:
    """Residual of a closed loop, step by step.

    Attributes
    ----------
    times : ndarray, shape (n_steps,), second
    open_loop : ndarray, shape (n_screens, n_steps), radian rms
        Screens without correction.
    residual : ndarray, shape (n_screens, n_steps), radian rms
        Screens less the mirror, not wrapped, piston removed.
    strehl : ndarray, shape (n_screens, n_steps)
        Of the residual.
    """

    times: NDArray[np.float64]
    open_loop: NDArray[np.float64]
    residual: NDArray[np.float64]
    strehl: NDArray[np.float64]

    @property
    def last_third(self) -> slice:
        """Last third of the steps, in which a loop counts as settled."""
        return slice(self.times.size - max(1, self.times.size // 3), None)

    def settled(self) -> NDArray[np.float64]:
        """Rms of the residual over the last third of the steps, shape (n_screens,), radian rms."""
        return np.sqrt(np.mean(self.residual[:, self.last_third] ** 2, axis=1))

    def closed(self) -> NDArray[np.bool_]:
        """Whether each loop settled below half of the error at its start, shape (n_screens,)."""
        return self.settled() < self.open_loop[:, 0] / 2

    def held(self) -> float:
        """Median residual (radian rms) at which the closed loops settled, NaN if none closed."""
        settled = self.settled()[self.closed()]
        return float(np.median(settled)) if settled.size else np.nan


def follow_flow(
    reconstructor: Any,
    modes: ArrayLike,
    flow: FrozenFlow,
    n_steps: int,
    *,
    rate: float = 1000.0,
    gain: float = 0.5,
    delay: int = 1,
    stroke: float | None = None,
    photons: float | None = None,
    seed: int | np.random.Generator | np.random.SeedSequence | None = None,
) -> LoopRun:
    """Correct drifting screens with an integrator that a Zernike sensor feeds.

    In each step the sensor measures the residual of the mirror; the reconstructed phase, its piston removed on the
    circle, is fitted by the modes, and the mirror gets `gain` times that more, `delay` steps later. Frames without
    a photon change nothing.

    Parameters
    ----------
    reconstructor : reconstructor
    modes : array_like, shape (n_modes, ny, nx)
        Of the mirror, linearly independent, such as those of `zernike_basis`.
    flow : FrozenFlow
        On the pupil of the reconstructor; its screens are corrected side by side.
    n_steps : int
    rate : float, 1 / second
    gain : float
        In (0, 2); the loop is stable for any estimate that is right below that, with a delay of 1.
    delay : int, steps
        From a measurement to its correction, at least 1.
    stroke : float, radian rms, optional
        Largest figure of the mirror; a command beyond it is scaled down to it. Any figure if left out.
    photons : float, photons / step, optional
        Detected within the pupil with the mask out, divided equally among the masks; no noise if left out.
    seed : int, Generator or SeedSequence, optional
        Of the noise.

    Returns
    -------
    LoopRun

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind, shape or range.
    """
    sensor = _check.sensor_of("reconstructor", reconstructor)
    pupil = sensor.pupil
    _check.instance("flow", flow, FrozenFlow)
    if flow.pupil.shape != pupil.shape or np.any(flow.pupil.inside != pupil.inside):
        raise ValueError(
            f"flow has {_check.shown(flow.pupil)}: expected that of the reconstructor, {_check.shown(pupil)}"
        )
    modes = _check.modes("modes", modes, sensor.pupil)
    n_steps = _check.integer("n_steps", n_steps, 1)
    rate = _check.number("rate", rate, 0, open_low=True)
    camera = None
    if photons is not None:
        photons = _check.number("photons", photons, 0, open_low=True)
        camera = Detector(pupil, photons / sensor.n_masks)
    times = np.arange(n_steps) / rate
    record = loop.close_loop(
        sensor,
        Mirror(pupil, pupil.scatter(modes, fill=0)),
        reconstructor,
        (flow(time) for time in times),
        gain=gain,
        delay=delay,
        stroke=stroke,
        camera=camera,
        seed=seed,
    )
    return LoopRun(times, record.open_loop, record.residual, record.strehl)


def compare_loops(
    reconstructors: Mapping[str, Any], modes: ArrayLike, flow: FrozenFlow, n_steps: int, **settings: Any
) -> dict[str, LoopRun]:
    """Close the loop with each of several reconstructors, on the same screens; see `follow_flow`."""
    check_reconstructors(reconstructors)
    return {name: follow_flow(one, modes, flow, n_steps, **settings) for name, one in reconstructors.items()}
