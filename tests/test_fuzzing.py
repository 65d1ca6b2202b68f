"""Camera files and options at random: each is used exactly as it was written, or refused by name.

`make test` tries 50 examples of each property, always the same ones. `make fuzz` tries 1000 new ones.
"""

import gc
import gzip
import io
import re
import warnings
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import example, given, settings
from hypothesis import strategies as st

from zwfs.bench import Bench, write_bench
from zwfs.frames import Calibration
from zwfs.frames import __main__ as command
from zwfs.frames import files as camera

examples = settings(max_examples=max(50, settings.default.max_examples))

# Camera files


@dataclass(frozen=True)
class Written:
    """Content of a file, and the images that it holds."""

    content: bytes
    images: np.ndarray

    def __repr__(self):
        return f"Written({self.content[:40]!r}..., shape {self.images.shape})"


def npy(image, version=(1, 0)):
    stream = io.BytesIO()
    np.lib.format.write_array(stream, image, version)
    return stream.getvalue()


def fits_file(units, **cards):
    """A FITS file whose units are an image, raw numbers with cards that scale them, or nothing."""
    hdus = fits.HDUList()
    for image in units:
        hdus.append(fits.ImageHDU(image) if hdus else fits.PrimaryHDU(image))
    hdus[-1].header.update({"EXPTIME": 0.5, "DIMPLE": 1.06, "THETA1": np.pi / 2, "THETA2": -np.pi / 2})
    for unit in hdus:
        unit.add_checksum(when="then")  # by default the time, which no example repeats
    stream = io.BytesIO()
    hdus.writeto(stream)
    content = stream.getvalue()
    # astropy would convert the numbers itself if it knew of these cards.
    old = next(iter(re.findall(rb"EXPTIME = .{70}", content)))
    lines = b"".join(f"{name:8}= {value:>20}".ljust(80).encode() for name, value in cards.items())
    place = content.index(old) + 80
    end = content.index(b"END".ljust(80), place) + 80
    header = content[:place] + lines + content[place:end]
    return header.ljust(-(-len(header) // 2880) * 2880) + content[-(-end // 2880) * 2880 :] if cards else content


@st.composite
def pixels(draw, shape, dtype):
    """Numbers of a type, which float64 holds exactly, with a few extreme ones."""
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    kind = np.dtype(dtype).kind
    if kind == "f":
        image = rng.uniform(0, 1000, shape).astype(dtype)
        special = [np.nan, np.inf, -np.inf, 0, -1, np.finfo(dtype).max]
    else:
        image = rng.integers(0, 100, shape).astype(dtype)
        limits = np.iinfo(dtype)
        special = [limits.min, min(limits.max, 2**53), 0]
    for value in draw(st.lists(st.sampled_from(special), max_size=3)):
        image.flat[rng.integers(image.size)] = value
    return image


SMALL = st.tuples(st.integers(1, 12), st.integers(1, 12))


@st.composite
def written(draw, shapes=SMALL):
    """Files of one image or two as cameras and programs write them."""
    shape, n = draw(shapes), draw(st.integers(1, 2))
    stacked = draw(st.booleans()) if n == 1 else True
    dtype = draw(st.sampled_from(["u1", "<i2", ">i2", "<u2", ">u4", "<i4", ">i8", "<f4", ">f4", "<f8", ">f8"]))
    image = draw(pixels((n, *shape) if stacked else shape, dtype))
    images = image.astype(np.float64).reshape(-1, *shape)
    match draw(st.integers(0, 5)):
        case 0:
            content = npy(image, draw(st.sampled_from([(1, 0), (2, 0)])))
        case 1:
            content = npy(np.asfortranarray(image))
        case 2:
            content = fits_file([image])
        case 3:
            content = fits_file([None, image])
        case 4:
            content = fits_file([None, *image] if stacked else [None, image])
        case 5:
            raw = draw(pixels(shape, ">i2"))
            scale, zero = draw(st.sampled_from([(1, 32768), (0.5, 0), (4, -8), (1, 0)]))
            cards = {"BSCALE": scale, "BZERO": zero, "BLANK": -32768}
            content = fits_file([raw], **draw(st.sampled_from([cards, dict(list(cards.items())[:2])])))
            images = (raw.astype(np.float64) * scale + zero)[np.newaxis]
            if b"BLANK" in content:
                images = np.where(raw == -32768, np.nan, images)
    if draw(st.booleans()):
        content = gzip.compress(content, 1, mtime=0)
    return Written(content, images)


PIECES = [
    *(b"NAXIS", b"BITPIX", b"9999999", b"-1", b"'", b"(((", b"|O", b"nan", b"(20, 30)", b"(99999999, 99999999)"),
    *(card.ljust(80) for card in (b"END", b"NAXIS1  = 9999999999", b"BSCALE  = 1e308", b"ZTILE1  = 99999999")),
    *(card.ljust(80) for card in (b"XTENSION= 'BINTABLE'", b"ZNAXIS1 = 99999999", b"PCOUNT  = 1e400")),
    *(card.ljust(80) for card in (b"BSCALE  = 'much'", b"BZERO   = T", b"BLANK   = 'no'", b"SATURATE= -1")),
    *(card.ljust(80) for card in (b"SATURATE= 'high'", b"THETA1  = 'left'", b"DIMPLE  = 1e99", b"GROUPS  = T")),
]


@st.composite
def damaged(draw, files):
    """A file that is cut, or has flipped bits, other characters, wrong header cards, gaps or a tail."""
    content = draw(files).content
    packed = content[:2] == b"\x1f\x8b" and draw(st.booleans())
    content = bytearray(gzip.decompress(content) if packed else content)
    for _ in range(draw(st.integers(1, 3))):
        size = len(content)
        place = draw(st.integers(0, min(size, draw(st.sampled_from([128, 1000, 6000, size])))))
        match draw(st.integers(0, 5)):
            case 0:
                del content[place:]
            case 1 if place < size:
                content[place] ^= 1 << draw(st.integers(0, 7))
            case 2 if place < size:
                content[place] = draw(st.integers(32, 126))
            case 3:
                piece = draw(st.sampled_from(PIECES))
                place -= place % 80 if len(piece) == 80 else 0
                content[place : place + len(piece)] = piece
            case 4:
                del content[place : place + draw(st.sampled_from([1, 80, 160]))]
            case 5:
                content += draw(st.binary(min_size=1, max_size=3000))
    return gzip.compress(content, 1, mtime=0) if packed else bytes(content)


# No extension says what a file holds, and none is needed.
names = st.sampled_from(["image.fits", "image.npy", "image.npz", "image.jpg", "image", "image é (1).fits.gz"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzzing")


def check_message(error, name):
    """Require one line that names the file or the parameter."""
    assert name in str(error)
    assert "\n" not in str(error)


def put(folder, name, content):
    path = folder / name
    path.write_bytes(content)
    return path


@pytest.fixture(scope="module", autouse=True)
def collected():
    """Collect what earlier tests did not close: it warns when it is collected, and warnings are errors here."""
    with warnings.catch_warnings(action="ignore"):
        gc.collect()


@pytest.mark.filterwarnings("error", "ignore::hypothesis.errors.HypothesisWarning")
@examples
@given(written(), names)
@example(Written(fits_file([np.full((2, 2), -32768, ">i2")], BSCALE=1, BZERO=32768, BLANK=-32768),
                 np.full((1, 2, 2), np.nan)), "image.fits")  # fmt: skip
def test_image_is_read_exactly(folder, file, name):
    path = put(folder, name, file.content)
    camera_file = camera.read(path)
    np.testing.assert_array_equal(camera_file.images, file.images)
    assert camera_file.name == name


@pytest.mark.filterwarnings("error", "ignore::hypothesis.errors.HypothesisWarning")
@examples
@given(damaged(written()))
@example(npy(np.ones((3, 4), "<f4")) + bytes(48))
def test_damaged_file_is_read_or_refused_by_name(folder, content):
    path = put(folder, "damaged.dat", content)
    try:
        frames, clear_frames, _ = camera.read_all([path], [path])
    except (TypeError, ValueError) as error:
        check_message(error, "damaged.dat")
        return
    assert all(np.isfinite(frame.counts).all() for frame in (*frames, *clear_frames))
    if content.startswith(b"\x93NUMPY"):
        with pytest.raises((TypeError, ValueError), match=r"damaged\.dat"):
            camera.read(put(folder, "damaged.dat", content + b"\0"))


# Calibration and telemetry


@pytest.fixture(scope="module")
def bench(folder):
    """Files of a bench and its calibration."""
    files = write_bench(folder, Bench(n_pixels=32), seed=1)
    Calibration.from_files([files["frame"]], [files["pupils"]], [files["dark"]]).save(folder / "bench.npz")
    return {name: str(path) for name, path in files.items()}


@pytest.fixture(scope="module")
def calibration(folder, bench):
    return Calibration.load(folder / "bench.npz")


def run(arguments):
    """Exit code and messages of the command; a traceback would end the test."""
    messages = io.StringIO()
    with redirect_stderr(messages), redirect_stdout(io.StringIO()):
        try:
            code = command.main([str(argument) for argument in arguments])
        except SystemExit as end:  # argparse
            code = end.code
    return code, messages.getvalue()


def check_refusal(code, messages, *named):
    """Require exit code 1 and one line that names the cause, or 2 and the usage."""
    assert code in (1, 2)
    assert "Traceback" not in messages
    if code == 1:
        assert re.fullmatch(r"error: [^\n]+\n", messages)
        assert any(name in messages for name in named)


SHAPE = 42, 84  # of the images of the bench


@pytest.mark.filterwarnings("error", "ignore::hypothesis.errors.HypothesisWarning", "ignore:.*raw counts")
@examples
@given(written(st.just(SHAPE)).flatmap(lambda whole: damaged(st.just(whole)) | st.just(whole.content)))
@example(fits_file([np.ones(SHAPE, ">i2")], SATURATE=-1))
@example(fits_file([np.ones(SHAPE, ">i2")], BSCALE="'much'"))
@example(npy(np.ones((1, *SHAPE))).replace(b"(1, 42", b"(-5,42"))
@example(fits_file([None, np.ones(SHAPE, np.uint8)]).replace(b"BITPIX", b"\2ITPIX", 1))
@example(fits_file([None, np.ones(SHAPE, np.uint8)]).replace(b"BITPIX", b"@ITPIX", 1))
def test_telemetry_is_that_of_the_counts_or_refused_by_name(folder, calibration, content):
    path, output = put(folder, "telemetry.dat", content), folder / "phases.fits"
    code, messages = run(
        ["reconstruct", path, "--calibration", folder / "bench.npz", "-o", output, "--workers", 1]
    )
    if code:
        check_refusal(code, messages, "telemetry.dat")
        assert not output.exists()
        return
    phases = fits.getdata(output)
    output.unlink()
    try:
        counts = camera.read(path).images
    except ValueError as error:
        check_message(error, "telemetry.dat")
        return
    expected = calibration(counts)
    np.testing.assert_allclose(phases, expected.phase, atol=1e-4)


@examples
@given(st.data())
def test_damaged_calibration_is_whole_or_refused_by_name(folder, calibration, data):
    whole = Written((folder / "bench.npz").read_bytes(), np.empty(0))
    try:
        loaded = Calibration.load(put(folder, "damaged.npz", data.draw(damaged(st.just(whole)))))
    except (TypeError, ValueError) as error:
        check_message(error, "damaged.npz")
    else:
        assert loaded.sha256 == calibration.sha256


words = st.sampled_from(["0", "-1", "1", "nan", "1e999", "1.5", "9" * 30, "high", "", "EXPTIME", "frame.fits"])
OPTIONS = {
    "calibrate": "dark bad-pixels diameter phase-shifts pupil-centers pupil-diameter exposure saturation fit "
    "iterations tolerance",
    "reconstruct": "second modes photons read-noise keywords saturation workers largest-residual",
}


@examples
@given(st.sampled_from([*OPTIONS]), st.data())
def test_options_are_used_or_refused(folder, bench, tool, data):
    option_names = st.sampled_from(OPTIONS[tool].split())
    options = data.draw(st.lists(st.tuples(option_names, st.lists(words, max_size=4)), max_size=2))
    output = folder / "options.npz"
    if tool == "calibrate":
        files = [output, "--frames", bench["frame"], "--pupils", bench["pupils"]]
    else:
        files = [bench["frame"], "--calibration", folder / "bench.npz", "-o", output]
    code, messages = run([tool, *files, *(word for name, values in options for word in (f"--{name}", *values))])
    if code:
        named = (name.strip("s").replace("-", "_") for name, _ in options)
        check_refusal(code, messages, *named, *filter(None, words.elements), "fitted", "pixels wide")
    else:
        output.unlink()
