"""Photons that sensors with masks in the focal plane need, Zernike sensors and pyramids. Not in the paper."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from numpy.typing import NDArray
from scipy import fft

from studies.kit import sweeps
from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded
from studies.kit.setups import screens_at
from studies.kit.style import OTHER_STYLES
from studies.kit.tables import MISSING, Table, Text
from zwfs.masks import Dimple
from zwfs.modes import noll_to_nm
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "diameter phase_shift n_screens exponent",
    n_pixels=(16, 64),
    n_modes=(3, 100),
    inputs=[(0.0, 3.0)],
    diameter_large=(0.1, 8.0),
    phase_shift_large=(0.01, 3.13),
    modulation=(0.1, 8.0),
    n_positions=(1, 200),
    padding=(2, 8),
    photons=(1.0, 1e12),
    read_noise=(0.0, 1e4),
    n_steps=(1, 100),
    shown=(0.0, 3.0),
)
QUICK = {"n_pixels": 24, "n_modes": 30, "n_screens": 1, "n_positions": 24}

_FLOOR = 1e-12  # of the information of a combination of modes, over the largest: below it rounding decides
_RECOVERED = 0.01  # error of a recovered screen, rad rms
_MOST = 1000.0  # a cost above it has no number
_TIP_TILT = 2  # modes
PYRAMID = "unmodulated pyramid"


FocalMask = Callable[[NDArray, NDArray], NDArray]
"""Transmission of a mask at the focal coordinates u, shape (n,), and v, shape (n, 1), lambda/D."""


class FocalSensor(Protocol):
    """A sensor with masks in the focal plane, which spreads all its light over a number of images."""

    @property
    def pupil(self) -> Pupil:
        """Pupil."""

    @property
    def n_images(self) -> int:
        """Number of images of the pupil."""

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Pixels of an image that the geometric image of the pupil covers."""

    def waves(self, fields: NDArray) -> Iterator[tuple[int, float, NDArray]]:
        """Yield the number of an image, a share of its light, and the fields behind a mask for that share."""


@dataclass(frozen=True)
class DimpleSensor:
    """Zernike sensor, by the low-rank model of the package; its images share the light equally."""

    name: str
    family: str
    model: ZernikeSensor

    @property
    def pupil(self) -> Pupil:
        """Pupil."""
        return self.model.pupil

    @property
    def n_images(self) -> int:
        """Number of images."""
        return self.model.n_masks

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Pixels in the image of the pupil."""
        inside = np.zeros(self.model.detector_shape, bool)
        inside[self.model.window] = self.model.pupil.inside
        return inside

    def waves(self, fields: NDArray) -> Iterator[tuple[int, float, NDArray]]:
        """Yield the fields behind each dimple."""
        waves = self.model.propagate(fields)
        for image in range(self.n_images):
            yield image, 1 / self.n_images, waves[:, image]


@dataclass(frozen=True)
class FilterSensor:
    """Sensor with masks of any size, by Fourier transforms.

    Each mask is a complex function of the focal coordinates (lambda/D) and has an image of its own; the images do
    not overlap. A beam splitter in front of the masks makes `n_beams` equal beams. The modulation moves the masks
    to the `positions` (lambda/D), one after the other, during an exposure.
    """

    name: str
    family: str
    pupil: Pupil
    padding: int  # width of the detector plane, D
    masks: Sequence[FocalMask]
    n_beams: int = 1
    positions: Sequence[tuple[float, float]] = ((0.0, 0.0),)

    @property
    def n_images(self) -> int:
        """Number of images."""
        return len(self.masks)

    @property
    def _side(self) -> int:
        """Pixels across the detector plane."""
        return self.padding * len(self.pupil.x)

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Pixels in the image of the pupil, which lies in a corner: the detector plane is periodic."""
        inside = np.zeros(2 * [self._side], bool)
        inside[: self.pupil.shape[0], : self.pupil.shape[1]] = self.pupil.inside
        return inside

    def waves(self, fields: NDArray) -> Iterator[tuple[int, float, NDArray]]:
        """Yield the fields behind each mask at each of its positions."""
        # Samples half a step off the axis: none lies on an edge through it.
        offset = 0.5 / self.padding
        u = fft.fftfreq(self._side, 1 / self.pupil.n_pixels) + offset
        ramp = np.exp(-2j * np.pi * offset * np.arange(len(self.pupil.x)) / self.pupil.n_pixels)
        tilted = (fields * np.outer(ramp, ramp)).astype(fields.dtype)
        light = fft.fft2(tilted, (self._side, self._side), norm="ortho")
        for image, mask in enumerate(self.masks):
            for x, y in self.positions:
                passed = np.multiply(light, mask(u - x, u[:, np.newaxis] - y), dtype=light.dtype)
                wave = fft.ifft2(passed, norm="ortho", overwrite_x=True)
                yield image, 1 / (self.n_beams * len(self.positions)), wave


def quadrants() -> list[FocalMask]:
    """Four faces of a pyramid, each of which sends a quadrant of the focal plane to an image of its own."""

    def face(across: int, up: int) -> FocalMask:
        return lambda u, v: (across * u > 0) & (up * v > 0)

    return [face(across, up) for across in (1, -1) for up in (1, -1)]


def edges() -> list[FocalMask]:
    """Two knife edges, of which each sends half of the focal plane to one image and half to another."""

    def half(side: int, upright: bool) -> FocalMask:
        return lambda u, v: side * (u if upright else v) > 0

    return [half(side, upright) for upright in (True, False) for side in (1, -1)]


def ring(radius: float, n_positions: int) -> list[tuple[float, float]]:
    """Positions of the modulation, lambda/D."""
    turns = (np.arange(n_positions) + 0.5) / n_positions
    return [(radius * float(np.cos(2 * np.pi * turn)), radius * float(np.sin(2 * np.pi * turn))) for turn in turns]


def compared_sensors(
    pupil: Pupil,
    small: tuple[float, float],
    large: tuple[float, float],
    modulation: float,
    n_positions: int,
    padding: int,
) -> list[DimpleSensor | FilterSensor]:
    """Return the sensors; `small` and `large` are diameter (lambda/D) and phase shift (radian) of dimples."""

    def dimples(name: str, family: str, diameter: float, *shifts: float) -> DimpleSensor:
        masks = [Dimple(diameter, shift) for shift in shifts]
        return DimpleSensor(name, family, ZernikeSensor(pupil, *masks, extent=padding))

    def pair(diameter: float, shift: float) -> DimpleSensor:
        return dimples(f"pair of {diameter:g} λ/D (±{shift / np.pi:.2g}π)", "pair", diameter, shift, -shift)

    circle = ring(modulation, n_positions)
    designs = dict.fromkeys([small, (large[0], small[1]), large])
    return [
        dimples(f"single dimple of {small[0]:g} λ/D", "one image", *small),
        *(pair(*design) for design in designs),
        FilterSensor(PYRAMID, "pyramid", pupil, padding, quadrants()),
        FilterSensor("unmodulated bi-O-edge", "bi-O-edge", pupil, padding, edges(), n_beams=2),
        FilterSensor(
            f"modulated pyramid, {modulation:g} λ/D", "modulated", pupil, padding, quadrants(), 1, circle
        ),
    ]


def frames_and_slopes(
    sensor: FocalSensor, phase: NDArray, modes: NDArray, dtype: Any = np.complex64
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Frames of a phase for one photon in all images, and their derivative with respect to each mode.

    A field o behind a mask depends linearly on the incoming field psi, so that a small change of the coefficient
    of the mode Z changes its intensity by 2 Re[conj(o) P(i psi Z)], where P is the propagation.
    """
    pupil = sensor.pupil
    psi = np.where(pupil.inside, pupil.amplitude * np.exp(1j * phase), 0) / np.sqrt(pupil.n_points)
    fields = np.concatenate([psi[np.newaxis], 1j * psi * modes]).astype(dtype)
    frames = np.zeros((sensor.n_images, *sensor.inside.shape), np.real(fields).dtype)
    slopes = np.zeros((len(modes), *frames.shape), frames.dtype)
    for image, share, (wave, *changes) in sensor.waves(fields):
        frames[image] += share * np.abs(wave) ** 2
        for slope, change in zip(slopes, changes, strict=True):
            slope[image] += 2 * share * (wave.real * change.real + wave.imag * change.imag)
    return frames, slopes


def mode_variances(
    frames: NDArray, slopes: NDArray, photons: float = 1.0, read_noise: float = 0.0
) -> NDArray[np.float64]:
    """Cramér-Rao bound of the variance of each mode, (n_modes,), radian^2, for `photons` in all images."""
    noise = frames / photons + (read_noise / photons) ** 2  # variance of each pixel, for frames of one photon
    lit = noise > 0
    changes = slopes[:, lit].astype(np.float64)
    values, vectors = np.linalg.eigh(changes / noise[lit] @ changes.T)
    return np.sum(vectors**2 / np.maximum(values, _FLOOR * values[-1]), axis=1)


def fit_error(sensor: FocalSensor, phase: NDArray, modes: NDArray, n_steps: int) -> float:
    """Error (rad rms) of a least-squares fit of noiseless frames that starts from a flat wavefront.

    The fit compares square roots of the frames, whose photon noise is the same everywhere, by the method of
    Levenberg and Marquardt. It knows the model exactly, and the phase is a sum of the modes.
    """
    data = np.sqrt(frames_and_slopes(sensor, phase, modes[:0])[0])

    def compare(coefficients: NDArray) -> tuple[NDArray, NDArray]:
        frames, slopes = frames_and_slopes(sensor, np.tensordot(coefficients, modes, 1), modes)
        root = np.sqrt(np.maximum(frames, np.finfo(frames.dtype).tiny))
        return (root - data).ravel(), (slopes / (2 * root)).reshape(len(modes), -1)

    coefficients, damping = np.zeros(len(modes)), 1e-2
    residual, slopes = compare(coefficients)
    for _ in range(n_steps):
        normal = slopes @ slopes.T
        step = np.linalg.solve(
            normal + damping * np.diag(normal.diagonal() + _FLOOR * normal.trace()), slopes @ residual
        )
        new_residual, new_slopes = compare(coefficients - step)
        if new_residual @ new_residual < residual @ residual:
            coefficients, residual, slopes = coefficients - step, new_residual, new_slopes
            damping /= 5
            if np.linalg.norm(step) < _RECOVERED / 10:
                break
        else:
            damping *= 5
    missed = np.tensordot(coefficients, modes, 1) - np.where(sensor.pupil.inside, phase, 0)
    return float(np.linalg.norm(missed) / np.sqrt(sensor.pupil.n_points))


@dataclass(frozen=True)
class SensorCurves:
    """Costs of sensors: variances over those of an ideal sensor, 1/(4 N) for N photons, means over the screens."""

    sensors: list[DimpleSensor | FilterSensor]
    inputs: NDArray[np.float64]  # (n_inputs,), rad rms, ascending
    costs: dict[str, NDArray[np.float64]]  # (n_inputs, n_modes), photon noise only
    noisy: dict[str, NDArray[np.float64]]  # (n_inputs, n_modes), with read noise
    cropped: dict[str, NDArray[np.float64]]  # (n_inputs, n_modes), only from pixels of the pupil images
    light: dict[str, NDArray[np.float64]]  # (n_inputs,), share of the light in the pupil images
    recovered: dict[str, NDArray[np.float64]]  # (n_inputs,), share of the screens; NaN where no fit was tried

    def nearest(self, rms: float) -> int:
        """Number of the input that is closest to `rms`."""
        return int(np.argmin(np.abs(self.inputs - rms)))

    def reach(self, name: str) -> float:
        """Largest input up to which the fit recovers every screen; NaN where no fit was tried, 0 if none."""
        shares = self.recovered[name]
        if np.isnan(shares).any():
            return np.nan
        return float(max(self.inputs[: int(np.argmin(np.append(shares, 0) >= 1))], default=0.0))


def sensor_curves(
    sensors: Sequence[DimpleSensor | FilterSensor],
    modes: NDArray,
    inputs: Sequence[float],
    n_screens: int,
    exponent: float,
    photons: float,
    read_noise: float,
    n_steps: int,
    seed: int,
) -> SensorCurves:
    """Costs of all sensors on the same screens, which are sums of the modes."""
    inputs = sorted(set(inputs))
    screens = [
        screens_at(modes, rms, n_screens if rms else 1, seed, task, exponent) for task, rms in enumerate(inputs)
    ]
    phases = [(sensor, screen) for sensor in sensors for group in screens for screen in group]
    rows = iter(sweeps.run(_row, phases, modes, photons, read_noise, n_steps, name="sensor_curves"))
    means = {
        sensor.name: [np.mean([next(rows) for _ in group], axis=0) for group in screens] for sensor in sensors
    }
    table = {name: np.array(groups) for name, groups in means.items()}
    parts = np.cumsum([len(modes)] * 3)
    costs, noisy, cropped, rest = (
        {name: np.split(values, parts, axis=1)[part] for name, values in table.items()} for part in range(4)
    )
    light, fitted = ({name: values[:, column] for name, values in rest.items()} for column in range(2))
    return SensorCurves(list(sensors), np.array(inputs), costs, noisy, cropped, light, fitted)


def _row(
    task: tuple[DimpleSensor | FilterSensor, NDArray],
    modes: NDArray,
    photons: float,
    read_noise: float,
    n_steps: int,
) -> NDArray[np.float64]:
    """Three costs of each mode, the share of light in the pupil images, and whether the fit succeeds."""
    sensor, phase = task
    frames, slopes = frames_and_slopes(sensor, phase, modes)
    inside = frames[:, sensor.inside], slopes[:, :, sensor.inside]
    variances = [
        mode_variances(frames, slopes),
        photons * mode_variances(frames, slopes, photons, read_noise),
        mode_variances(*inside),
    ]
    # A fit of a modulated sensor takes minutes.
    modulated = isinstance(sensor, FilterSensor) and len(sensor.positions) > 1
    fitted = np.nan if modulated else fit_error(sensor, phase, modes, n_steps) < _RECOVERED
    return np.concatenate([4 * np.concatenate(variances), [inside[0].sum(dtype=np.float64), fitted]])


def _tip_tilt(costs: NDArray) -> NDArray[np.float64]:
    """Mean cost of tip and tilt."""
    return costs[..., :_TIP_TILT].mean(axis=-1)


def _higher(costs: NDArray) -> NDArray[np.float64]:
    """Mean cost of the higher modes, all but tip and tilt."""
    return costs[..., _TIP_TILT:].mean(axis=-1)


_LOOKS: dict[str, dict[str, Any]] = {
    "one image": OTHER_STYLES[3],
    "pair": OTHER_STYLES[0],
    "pyramid": OTHER_STYLES[1] | {"linestyle": "-"},
    "bi-O-edge": OTHER_STYLES[2],
    "modulated": OTHER_STYLES[1] | {"marker": "d", "linestyle": ":"},
}
_PAIRS: tuple[dict[str, Any], ...] = (
    {},
    {"marker": "s", "linestyle": "--"},
    {"marker": "*", "linestyle": "-.", "markersize": 9},
)
"""What distinguishes the pairs from each other."""


def draw_sensor_photons(curves: SensorCurves) -> Figure:
    """Cost against input: of the higher modes, of tip and tilt, and of the higher modes with read noise."""
    figure, panels = plt.subplots(1, 3, figsize=(7, 4.2), sharey=True)
    for axes, title, values, average in (
        (panels[0], "higher modes", curves.costs, _higher),
        (panels[1], "tip and tilt", curves.costs, _tip_tilt),
        (panels[2], "higher modes, read noise", curves.noisy, _higher),
    ):
        pairs = {"pair": iter(_PAIRS)}
        for sensor in curves.sensors:
            look = _LOOKS[sensor.family] | next(pairs.get(sensor.family, iter(())), {})
            axes.plot(curves.inputs, average(values[sensor.name]), label=sensor.name, **look)
        axes.axhline(1, color="#555555", lw=1)
        axes.set(yscale="log", xlabel="input (rad rms)", title=title)
        axes.title.set_fontsize(10)
        axes.yaxis.set(major_locator=LogLocator(subs=(1, 2, 5)), major_formatter="{x:g}")
        axes.yaxis.set_minor_locator(NullLocator())
    panels[0].set(ylabel="cost (ideal sensor: 1)", ylim=(0.9, None))
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=2, fontsize=9)
    return figure


def _times(cost: float) -> str:
    """Return a cost with two digits."""
    return f"{float(f'{cost:.2g}'):g}" if cost <= _MOST else f"over {_MOST:g}"


def findings(curves: SensorCurves) -> Text:
    """Sentences on the figure: the best sensors, the paper's pair, the pyramid, tip and tilt."""
    pairs = _pairs(curves)
    higher = {name: _higher(cost) for name, cost in curves.costs.items()}
    low, high = curves.inputs[[0, -1]]
    best, best_high = (min(higher, key=lambda name: higher[name][end]) for end in (0, -1))
    tilt = {name: _tip_tilt(cost)[0] for name, cost in curves.costs.items()}
    best_tilt = min(tilt, key=lambda name: tilt[name])
    first, last = pairs[0], pairs[-1]
    return Text(
        f"**Of these sensors, the {best} needs the fewest photons {_place(low)}: {_times(higher[best][0])} times "
        f"those of an ideal sensor. {_place(high).capitalize()} the {best_high} needs the fewest, "
        f"{_times(higher[best_high][-1])} times.** The {first} needs {_times(higher[first][0])} times as many as "
        f"an ideal sensor {_place(low)}, and {_times(higher[first][-1])} times {_place(high)}. These "
        "numbers are bounds for photon noise alone, and means over the higher modes, all but tip and tilt. For "
        f"tip and tilt {_place(low)}, the {best_tilt} needs the fewest photons, {_times(tilt[best_tilt])} times "
        f"those of an ideal sensor, and the {last} needs {_times(tilt[last])} times."
    )


def _place(rms: float) -> str:
    """Return an input in words."""
    return f"at {rms:g} rad rms" if rms else "on a flat wavefront"


def fit_findings(curves: SensorCurves) -> Text:
    """Sentences on the range of the fit."""
    reach = {name: curves.reach(name) for name in curves.costs}
    farthest = max(reach, key=lambda name: np.nan_to_num(reach[name], nan=-1.0))
    first = _pairs(curves)[0]
    ranges = {name: _up_to(reach[name], curves.inputs[-1]) for name in (farthest, first)}
    return Text(
        "**Without noise, a least-squares fit that starts from a flat wavefront has the longest range with the "
        f"{farthest}: it recovers every screen {ranges[farthest]}.** With the {first} it recovers every screen "
        f"{ranges[first]}."
    )


def _pairs(curves: SensorCurves) -> list[str]:
    """Names of the pairs, that of the paper first."""
    return [sensor.name for sensor in curves.sensors if sensor.family == "pair"]


def _up_to(reach: float, largest: float) -> str:
    """Return the range of a fit in words."""
    if not reach > 0:
        return "of a flat wavefront at most"
    return f"up to {reach:g} rad rms{', the largest input here' if reach == largest else ''}"


def conditions_table(curves: SensorCurves, rms: float, read_noise: float) -> Table:
    """What the costs of the higher modes depend on, at the input that is closest to `rms`."""
    at = curves.nearest(rms)
    input_ = f"{curves.inputs[at]:g} rad rms"
    header = [
        "sensor",
        "images",
        f"light beside the images, {input_}",
        f"cost, {input_}: all light",
        "cost: only pupil images",
        f"cost: read noise {read_noise:g} e⁻",
        "fit recovers up to (rad rms)",
    ]
    rows = []
    for sensor in curves.sensors:
        name = sensor.name
        costs = [float(_higher(values[name][at])) for values in (curves.costs, curves.cropped, curves.noisy)]
        reach = curves.reach(name)
        rows.append(
            [
                name,
                sensor.n_images,
                f"{1 - curves.light[name][at]:.0%}",
                *map(_times, costs),
                MISSING if np.isnan(reach) else f"{reach:g}",
            ]
        )
    return Table(header, rows)


def modes_table(curves: SensorCurves, rms: float) -> Table:
    """Cost for photon noise by radial order, at the input that is closest to `rms`."""
    at = curves.nearest(rms)
    n_modes = next(iter(curves.costs.values())).shape[-1]
    orders = np.array([noll_to_nm(mode + 2)[0] for mode in range(n_modes)])
    return Table(
        [f"radial order, at {curves.inputs[at]:g} rad rms", *map(str, np.unique(orders))],
        [
            [name, *(_times(cost[at][orders == order].mean()) for order in np.unique(orders))]
            for name, cost in curves.costs.items()
        ],
    )


def numbers(curves: SensorCurves, rms: float) -> dict[str, float | str]:
    """Costs of the higher modes that other pages quote: flat, and at the input that is closest to `rms`."""
    first, *_, last = _pairs(curves)
    named = {"paper": first, "large": last, "pyramid": PYRAMID}
    return rounded(
        {
            f"{key}_{place}": float(_higher(curves.costs[name][at]))
            for key, name in named.items()
            for place, at in (("flat", 0), ("aberrated", curves.nearest(rms)))
        },
        ".3g",
    )
