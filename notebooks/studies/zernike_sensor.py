"""One pixel of a phase-shifted sensor: the phases that explain each of its intensities. Not in the paper."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import HTML
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import ArrayLike, NDArray

from studies.kit.drawings import FOCUS_MAP, Picture, draw_layout, focal_light
from studies.kit.parameters import USUAL
from studies.kit.style import INTENSITY_MAP, LOOKS, PHASE_MAP, dashed_circle, show_phase
from studies.kit.tables import Text
from zwfs.metrics import wrapped_residual
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

LIMITS = {name: USUAL[name] for name in ("n_pixels", "diameter", "phase_shift")} | {"height": (0.1, 3.0)}

CENTRE = 0.22  # distance of the bump and of the pit from the middle of the pupil, D


@dataclass(frozen=True)
class Pixel:
    """One pixel inside the pupil, and what each mask shows of it."""

    row: int
    column: int
    phase: float  # radian
    waves: NDArray[np.complex128]  # (n_masks,), reference waves over the amplitude of the pixel

    def intensities(self, phase: ArrayLike) -> NDArray[np.floating]:
        """Intensity behind each mask, equation (5), if the pixel had another phase."""
        field = np.exp(1j * np.asarray(phase))
        return np.abs(np.add.outer(self.waves, field)) ** 2

    @property
    def mirrored(self) -> NDArray[np.floating]:
        """Other phase in (-pi, pi] with the same intensity, for each mask; `eq-reflection` of the book."""
        return np.angle(np.exp(1j * (2 * np.angle(self.waves) - self.phase)))


def bump_and_pit(pupil: Pupil, height: float, width: float = 0.1) -> NDArray[np.floating]:
    """Return a phase with a Gaussian bump on the left and a pit of the same depth on the right."""

    def bell(distance: NDArray) -> NDArray:
        return np.exp(-(distance**2) / (2 * width**2))

    return height * np.outer(bell(pupil.y), bell(pupil.x + CENTRE) - bell(pupil.x - CENTRE))


def lowest_pixel(sensor: ZernikeSensor, phase: NDArray) -> Pixel:
    """Return the pixel of the lowest phase inside the pupil."""
    pupil = sensor.pupil
    waves = sensor.reference_wave(pupil.field(phase))[(..., *sensor.window)]
    inside = np.where(pupil.inside, phase, np.inf)
    row, column = map(int, np.unravel_index(np.argmin(inside), inside.shape))
    return Pixel(row, column, float(phase[row, column]), waves[:, row, column] / pupil.amplitude[row, column])


IMAGES = ("1", "#B2182B", "-"), ("2", "#313695", "--")
"""Name, colour and line of the images of both masks, as in Figure 2."""
_WIDTH = 6.8  # inches: names of 10 points are then as large as the prose
_REACH = 3.0  # of the picture of the focal plane, lambda/D
_GREY = "#707070"


def draw_sensor_steps(sensor: ZernikeSensor, phase: NDArray, pixel: Pixel) -> Figure:
    """Path of the light: pupil, focus with the first mask, and the reference wave and the image on the camera."""
    pupil = sensor.pupil
    field = pupil.field(phase)
    wave = np.abs(sensor.reference_wave(field)[0]) ** 2
    image = sensor.measure(phase)[0]
    inside = np.where(pupil.inside, phase, np.nan)
    limit = np.nanmax(np.abs(inside))
    focus = focal_light(pupil, field, _REACH)
    pictures = {
        "pupil": Picture(inside, PHASE_MAP, -limit, limit, "phase (rad)"),
        "focus": Picture(focus, FOCUS_MAP, -3, 0, "intensity in the focus (log10)"),
        "wave": Picture(wave, INTENSITY_MAP, 0, wave.max(), "intensity of the reference wave"),
        "image": Picture(image, INTENSITY_MAP, 0, image.max(), "intensity of the image"),
    }

    def mark(shown: dict[str, Axes], narrow: bool) -> None:
        """Edge of the dimple, and the pixel."""
        middle = (len(focus) - 1) / 2
        dashed_circle(shown["focus"], (middle, middle), sensor.masks[0].diameter / 2 * middle / _REACH)
        for name, color in (("pupil", "black"), ("image", "white")):
            shown[name].plot(pixel.column, pixel.row, "s", mfc="none", mec=color, ms=7, mew=1.5)

    return draw_layout("zernike_sensor.svg", "zernike_sensor_narrow.svg", pictures, marks=mark)


def draw_pixel_phasors(pixel: Pixel) -> Figure:
    """Waves of one pixel as arrows in the complex plane, for both masks, and both intensities by its phase."""
    figure, panels = plt.subplot_mosaic(
        [["1", "2"], ["curves", "curves"]], figsize=(_WIDTH, 6.4), height_ratios=(5, 4)
    )
    curves = panels["curves"]
    angles = np.linspace(-np.pi, np.pi, 361)
    for k, (name, color, line) in enumerate(IMAGES):
        _phasors(panels[name], pixel, k)
        level = pixel.intensities(pixel.phase)[k]
        curves.plot(angles, pixel.intensities(angles)[k], color=color, ls=line, lw=2, label=f"_image {name}")
        curves.axhline(level, color=color, ls=line, lw=0.8)
        curves.plot(pixel.mirrored[k], level, "o", color=color, mfc="white", mew=2, ms=9, zorder=4)
        top = int(np.argmax(pixel.intensities(angles)[k]))
        curves.text(angles[top], 3.05, f"image {name}", ha="center", color=color)
    curves.plot([pixel.phase] * 2, pixel.intensities(pixel.phase), "o", color="black", ms=9, zorder=5)
    curves.axvline(pixel.phase, color=_GREY, lw=0.8, ls=":")
    curves.set(xlabel="phase of the pixel (rad)", ylabel="intensity", xlim=(-np.pi, np.pi), ylim=(0, 3.4))
    return figure


def _phasors(axes: Axes, pixel: Pixel, k: int) -> None:
    """Reference wave and wave of the pixel, tip to tail, for both phases with the same intensity."""
    name, color, _ = IMAGES[k]
    wave, intensity = pixel.waves[k], pixel.intensities(pixel.phase)[k]
    axes.add_patch(Circle((wave.real, wave.imag), 1, fill=False, ec=_GREY, ls=":", lw=1.5))
    axes.add_patch(Circle((0, 0), np.sqrt(intensity), fill=False, ec=color, lw=1.5))
    style: dict[str, Any] = {"color": _GREY, "fontsize": 9, "ha": "right", "va": "center"}
    ground = {"fc": "white", "ec": "none", "pad": 0.5}
    axes.text(wave.real + 0.04, 0.1 * wave.imag + 0.12, "reference\nwave", bbox=ground, zorder=1.5, **style)
    axes.plot(0, 0, "+", color="black", ms=8)
    for phase, line, shade in ((pixel.phase, "-", "black"), (pixel.mirrored[k], "--", color)):
        turn = np.exp(1j * phase)
        _arrow(axes, wave, wave + turn, color=shade, ls=line)
        point, label = wave + turn, wave + 1.18 * turn
        axes.plot(point.real, point.imag, "o", color=shade, mfc="white" if line == "--" else shade, mew=2, ms=8)
        side = "left" if turn.real > 0.5 else "right" if turn.real < -0.5 else "center"
        height = "top" if turn.imag < -0.5 else "bottom" if turn.imag > 0.5 else "center"
        text = f"{phase:+.2f} rad".replace("-", "−")
        axes.text(label.real, label.imag, text, color=shade, ha=side, va=height)
    _arrow(axes, 0, wave, color=_GREY)  # last: its head covers the starts of the others
    axes.set(title=f"image {name}: intensity {intensity:.2f}", xlim=(-2.3, 1.7), ylim=(-2, 1.6), aspect="equal")
    axes.set_axis_off()


def _arrow(axes: Axes, start: complex, end: complex, **style: Any) -> None:
    """Arrow in the complex plane."""
    start, end = complex(start), complex(end)
    shape = {"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0, "mutation_scale": 14, "lw": 2}
    axes.annotate("", (end.real, end.imag), (start.real, start.imag), arrowprops=shape | style)


def draw_one_or_two_images(pupil: Pupil, truth: NDArray, phases: Mapping[str, NDArray]) -> Figure:
    """True phase (radian), and the phases that methods reconstruct, with their errors."""
    truth = np.where(pupil.inside, truth, np.nan)
    limit = np.nanmax(np.abs(truth))
    figure, panels = plt.subplots(1, 1 + len(phases), figsize=(_WIDTH, 2.7))
    shown = show_phase(panels[0], truth, limit)
    panels[0].set_title("true phase\n", fontsize=10)
    for axes, (name, phase) in zip(panels[1:], phases.items(), strict=True):
        residual = wrapped_residual(pupil, phase, truth)
        show_phase(axes, truth + residual, limit)
        error = float(np.sqrt(np.nanmean(residual**2)))
        images = LOOKS[name].sees.replace("pupils", "images").replace("pupil", "image")
        axes.set_title(f"from {images}:\n{_error(error)}", fontsize=10)
    figure.colorbar(shown, ax=panels, label="phase (rad)", aspect=15)
    return figure


def _error(value: float) -> str:
    return f"error {value:.2f} rad rms" if value >= 5e-3 else "no error"


def findings_pixel(pixel: Pixel) -> Text:
    """Return the phases that explain the intensities of the pixel."""
    first, second = pixel.mirrored
    return Text(
        f"The pixel has a phase of {pixel.phase:.2f} rad, but image 1 alone also allows {first:.2f} rad, and "
        f"image 2 alone {second:.2f} rad. Only {pixel.phase:.2f} rad explains both images."
    )


def findings_arcsine(phase: NDArray, pixel: Pixel) -> Text:
    """Return the phase from one image at the pixel, next to the other phase that explains this image."""
    return Text(
        f"At the pixel of [the figure with the arrows](#fig-zernike-phasors), the arcsine gives "
        f"{phase[pixel.row, pixel.column]:.2f} rad. The wrong solution of image 1 is {pixel.mirrored[0]:.2f} rad."
    )


def explorer(pixel: Pixel) -> HTML:
    """Place of the interactive phasors, with the computed reference waves; book/_static/phasor.js draws them."""
    waves = json.dumps([[round(wave.real, 4), round(wave.imag, 4)] for wave in pixel.waves.tolist()])
    return HTML(
        f'<div id="phasor" class="d-print-none" data-waves="{waves}" data-phase="{pixel.phase:.2f}" hidden></div>'
    )
