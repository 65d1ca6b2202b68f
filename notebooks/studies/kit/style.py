"""The style of all figures: colours and markers of the methods, colour maps, resolution."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.image import AxesImage
from matplotlib.patches import Circle
from numpy.typing import NDArray

PHASE_MAP, INTENSITY_MAP = "RdBu_r", "viridis"
ALONE = "alone"
"""Group of the panels that share their row with no other on a phone."""
TALL = "tall"
"""Group of the panels that are half as tall again on a phone."""
# Of phases on a dark ground: 0 is dark, the signs keep their hues, and opposite phases are equally light.
DARK_PHASE_MAP = LinearSegmentedColormap.from_list(
    "zwfs_dark_phase", ["#9fd2ff", "#2f7fc9", "#2a2a2e", "#d1493f", "#ffb8ad"]
)


@dataclass(frozen=True)
class Look:
    """Name, colour, marker and dashes of a method, the same in every figure."""

    name: str
    sees: str
    color: str
    marker: str
    line: str | tuple[float, tuple[float, ...]]

    @property
    def label(self) -> str:
        """Name for a legend."""
        return f"{self.name} ({self.sees})" if self.sees else self.name

    @property
    def style(self) -> dict[str, Any]:
        """Keywords of a curve for `plot`."""
        return {"color": self.color, "marker": self.marker, "linestyle": self.line}


# Colours that differ from those of the methods for every reader, for methods that are not listed.
_SPARE = (("#882255", "<", "-"), ("#56B4E9", ">", "--"), ("#A080FF", "H", "-."))


class _Looks(dict[str, Look]):
    """Looks by the name of a method; a name that is not listed gets the next spare look."""

    def __missing__(self, name: str) -> Look:
        words = re.sub("(?<!^)(?=[A-Z])", " ", name).lower()  # of the name of a class
        self[name] = look = Look(words, "", *_SPARE[len(self) % len(_SPARE)])
        return look


# Okabe and Ito's palette, which colour-blind readers can distinguish; marker and dashes repeat the difference.
LOOKS = _Looks()
"""Look of each method, by the name of its class; a name that is not listed gets a spare look at its first use."""
LOOKS |= {
    "Linear": Look("linear", "one image", "#000000", "o", "-"),
    "Arcsine": Look("arcsine", "one image", "#E69F00", "s", "--"),
    "GerchbergSaxton": Look("Gerchberg-Saxton", "two images", "#009E73", "^", "-."),
    "GerchbergSaxtonModel": Look("Gerchberg-Saxton, modelled field", "two images", "#74583E", "x", "-"),
    "GradientDescent": Look("gradient descent on modes", "two images", "#CC79A7", "D", (0, (3, 1, 1, 1, 1, 1))),
    "GradientDescentPoints": Look("gradient descent on points", "two images", "#D55E00", "d", "--"),
    "PhaseShifted": Look("phase-shifted", "two images", "#0072B2", "v", ":"),
    "LearnedReference": Look("learned reference wave", "two images", "#7800F0", "8", "-"),
    "MaximumLikelihood": Look("maximum likelihood", "", "#661100", "*", "-"),
}
# Curves that stand for no method have other colours, from Tol's muted palette, and other markers.
OTHER_STYLES: tuple[dict[str, Any], ...] = tuple(
    {"color": color, "marker": marker, "linestyle": line}
    for color, marker, line in (
        ("#332288", "P", "-"),
        ("#AA4499", "X", "--"),
        ("#44AA99", "p", "-."),
        ("#999933", "h", ":"),
    )
)
_RC: dict[Any, Any] = {
    "figure.dpi": 100,
    "savefig.dpi": 200,
    "savefig.bbox": None,
    "figure.constrained_layout.use": True,
    "font.size": 10,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "image.cmap": INTENSITY_MAP,
    "image.interpolation": "nearest",
    "image.origin": "lower",
    # Element ids of SVG files are random unless salted.
    "svg.hashsalt": "zwfs",
}


def use_style(*, vector: bool = False) -> None:
    """Draw figures of this session alike; in a notebook, as sharp PNG or, if `vector`, as SVG without a date."""
    plt.rcParams.update(_RC)
    try:
        from matplotlib_inline.backend_inline import set_matplotlib_formats
    except ImportError:
        return
    if vector:
        set_matplotlib_formats("svg", bbox_inches=None, metadata={"Date": None})
    else:
        set_matplotlib_formats("png", bbox_inches=None, dpi=200)


def show_phase(axes: Axes, phase: NDArray, limit: float) -> AxesImage:
    """Phase map, diverging around 0 from -`limit` to `limit` (radian)."""
    return _show(axes, phase, PHASE_MAP, -limit, limit)


def show_intensity(axes: Axes, frame: NDArray, limit: float) -> AxesImage:
    """Intensity from 0 to `limit`."""
    return _show(axes, frame, INTENSITY_MAP, 0, limit)


def dashed_circle(axes: Axes, center: tuple[float, float], radius: float) -> None:
    """Edge of a dimple: white dashes on black, to be seen on dark and on bright light."""
    for color, line, width in (("black", "-", 3.0), ("white", "--", 1.4)):
        axes.add_patch(Circle(center, radius, fill=False, ec=color, ls=line, lw=width))


def _show(axes: Axes, image: NDArray, colors: str, low: float, high: float) -> AxesImage:
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    axes.spines[:].set_visible(False)
    return axes.imshow(image, cmap=colors, vmin=low, vmax=high)


def looks_of(methods: Iterable[str]) -> list[tuple[str, Look]]:
    """Names and looks of methods, in the order of `LOOKS`."""
    looks = {name: LOOKS[name] for name in methods}
    return [(name, looks[name]) for name in LOOKS if name in looks]
