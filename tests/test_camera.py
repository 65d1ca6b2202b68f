"""Camera files: what is read, what is refused, and that no file is lost."""

import gzip
import io
import pickle
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from zwfs.bench import Bench, write_bench
from zwfs.frames import files as camera

# Reading


FRAME = np.arange(600, dtype=np.int64).reshape(20, 30) % 250


def fits_bytes(*units):
    stream = io.BytesIO()
    fits.HDUList(list(units)).writeto(stream)
    return stream.getvalue()


def npy_bytes(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def column(name):
    return fits.BinTableHDU.from_columns([fits.Column(name=name, format="D", array=np.zeros(3))])


def write(path, *images, names=(), **cards):
    """A FITS file with images in its units."""
    units = [fits.PrimaryHDU(images[0], fits.Header(cards)), *map(fits.ImageHDU, images[1:])]
    for unit, name in zip(units[1:], names, strict=False):
        unit.name = name
    fits.HDUList(units).writeto(path, overwrite=True)
    return path


def test_nan_dark_and_bad_pixel_map(tmp_path):
    counts = FRAME.astype(float)
    counts[3, 4], counts[5, 6] = np.nan, np.inf
    marked = np.zeros(FRAME.shape)
    marked[7, 8] = 1
    dark = np.full(FRAME.shape, 10.0)
    dark[9, 9] = np.nan
    frame, lightless, map_ = (write(tmp_path / f"{k}.fits", data) for k, data in enumerate((counts, dark, marked)))
    (image,), _, _ = camera.read_all([frame], [frame], [lightless], [map_], saturation=1e5)
    assert np.argwhere(image.bad).tolist() == [[3, 4], [5, 6], [7, 8], [9, 9]]
    assert np.isfinite(image.counts).all()
    assert image.counts[0, 5] == FRAME[0, 5] - 10


@pytest.mark.parametrize(
    ("counts", "settings", "level"),
    [
        (FRAME.astype(float), {}, np.inf),
        (FRAME.astype(float), {"SATURATE": 249}, 249),
        ((FRAME + 6).astype(np.uint8), {}, 255),
        (FRAME.astype(float), {"saturation": 240}, 240),
        (np.minimum(FRAME, 200).astype(float), {}, 200),
    ],
)
def test_saturation_is_given_in_the_header_of_the_type_or_seen(tmp_path, counts, settings, level):
    cards = {key: value for key, value in settings.items() if key.isupper()}
    path = write(tmp_path / "a.fits", counts, **cards)
    (image,), _, _ = camera.read_all([path], [path], saturation=settings.get("saturation"))
    np.testing.assert_array_equal(image.bad, counts >= level)


@pytest.mark.parametrize(
    ("others", "message"),
    [
        (([FRAME] * 2,), r"dark\.fits: 2 images for the 1"),
        (([FRAME + np.nan],), r"frame\.fits, dark\.fits: all pixels are bad"),
        (((), [(FRAME != 7).astype(int)]), r"bad_pixels: map\.fits marks 99\.5% .* 1 = good"),
        (((), [FRAME.T]), r"bad_pixel_files: map\.fits has shape"),
    ],
)
def test_files_that_do_not_fit_together(tmp_path, others, message):
    frame = write(tmp_path / "frame.fits", FRAME)
    named = zip(("dark.fits", "map.fits"), others, strict=False)
    paths = [[write(tmp_path / name, *images)] if images else () for name, images in named]
    with pytest.raises(ValueError, match=message):
        camera.read_all([frame], [frame], *paths)


def test_astropy_is_named_where_it_is_missing(monkeypatch, tmp_path):
    fits.PrimaryHDU(FRAME).writeto(tmp_path / "a.fits")
    monkeypatch.setitem(sys.modules, "astropy.io", None)
    with pytest.raises(ImportError, match="pip install astropy"):
        camera.read(tmp_path / "a.fits")


@pytest.mark.parametrize("start", [b"", b"\x93NUMPY", b"SIMPLE  =                    T"])
def test_unpacking_stops_at_the_limit(tmp_path, start):
    path = tmp_path / "bomb.fits.gz"
    path.write_bytes(gzip.compress(start + bytes(64 << 20), 1))
    assert path.stat().st_size < 1 << 20
    tracemalloc.start()
    with pytest.raises(camera.FileError, match=r"bomb\.fits\.gz: "):
        camera.read(path, max_bytes=4 << 20)
    assert tracemalloc.get_traced_memory()[1] < 16 << 20
    tracemalloc.stop()


def test_largest_size_counts_the_file_and_the_images(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, FRAME.astype(np.uint8))
    assert camera.read(path, max_bytes=8 * FRAME.size).images.nbytes == 8 * FRAME.size
    with pytest.raises(camera.FileError, match=r"a\.npy: its shape is \(20, 30\), 4800 bytes"):
        camera.read(path, max_bytes=8 * FRAME.size - 1)
    with pytest.raises(camera.FileError, match=r"a\.npy: it is larger than 700 bytes"):
        camera.read(path, max_bytes=700)


def test_cards_that_do_not_follow_the_standard_are_left_out(tmp_path):
    content = fits_bytes(fits.PrimaryHDU(FRAME, fits.Header({"EXPTIME": 4, "WAVELEN": 633.0})))
    old = b"EXPTIME =                    4"
    assert content.count(old) == 1
    (tmp_path / "a.fits").write_bytes(content.replace(old, b"EXPTIME =             12:30:44"))
    file = camera.read(tmp_path / "a.fits")
    assert file.keyword("WAVELEN") == 633
    with pytest.raises(ValueError, match=r"a\.fits: its header has no EXPTIME"):
        file.keyword("EXPTIME")


def test_keyword_that_no_bench_can_have_is_named_where_it_is_needed():
    for value in (0, -5, np.inf, "red"):
        file = camera.CameraFile(FRAME[np.newaxis], "a.fits", "", {"WAVELEN": value})
        with pytest.raises((TypeError, ValueError), match=r"a\.fits: WAVELEN = "):
            file.keyword("WAVELEN")


# Exposures, darks and units


@pytest.fixture
def light():
    """Two images of one exposure, with a few counts between exposures."""
    return np.stack([FRAME + 1000.0, 2000.0 - FRAME])


@pytest.mark.parametrize("kind", ["cube", "many files", "pairs", "two files", "stated pair"])
def test_exposures_are_averaged_and_images_are_kept_apart(tmp_path, light, kind):
    change = np.arange(-2.0, 3.0)[:, np.newaxis, np.newaxis, np.newaxis]
    exposures = light + change
    written, images = {
        "cube": ([exposures[:, 0]], 1),
        "many files": (exposures[:, 0], 1),
        "pairs": ([exposures], 2),
        "two files": ([exposures[:, 0], exposures[:, 1]], 2),
        "stated pair": ([light], 2),
    }[kind]
    paths = [write(tmp_path / f"{index}.fits", image) for index, image in enumerate(written)]
    stated = {"n_images": 2} if kind == "stated pair" else {}
    frames, clear, sources = camera.read_all(paths, paths, saturation=1e5, **stated)
    for averaged in (frames, clear):
        np.testing.assert_allclose([image.counts for image in averaged], light[:images])
    assert len(sources) == 2 * len(paths)


def test_two_exposures_are_not_two_images(tmp_path, light):
    path = write(tmp_path / "two.fits", light)
    (frame,), _, _ = camera.read_all([path], [path])
    np.testing.assert_allclose(frame.counts, light.mean(axis=0))
    with pytest.raises(ValueError, match=r"two\.fits: 1 images in an exposure: expected n_images = 2"):
        camera.read_all([write(path, light[0])], [path], n_images=2)


def test_pixel_that_is_saturated_in_one_exposure_is_bad(tmp_path):
    cube = np.stack([FRAME] * 4).astype(np.uint16)
    cube[1, 3, 4] = 65535
    path = tmp_path / "a.npy"
    np.save(path, cube)
    (frame,), _, _ = camera.read_all([path], [path])
    assert np.argwhere(frame.bad).tolist() == [[3, 4]]


SETTINGS = {
    "shapes": (FRAME[:-2, :-4], {}, {}),
    "exposure times": (FRAME, {"EXPTIME": 2.0}, {"EXPTIME": 0.5}),
    "windows": (FRAME, {"DETSEC": "[1:30,1:20]"}, {"DETSEC": "[9:38,1:20]"}),
}


@pytest.mark.parametrize("kind", [*SETTINGS, "stated"])
def test_each_kind_of_frame_has_its_own_dark(tmp_path, kind):
    image, cards, others = SETTINGS.get(kind, (FRAME, {}, {}))
    frame = write(tmp_path / "frame.fits", image + 100.0, **cards)
    pupils = write(tmp_path / "pupils.fits", FRAME + 10.0, **others)
    darks = [
        write(tmp_path / "dark1.fits", 0 * FRAME + 10.0, **others),
        write(tmp_path / "dark2.fits", np.stack([0 * image + 99.0, 0 * image + 101]), **cards),
    ]
    dark_files = [[darks[1]], darks[:1]] if kind == "stated" else [darks, ()]
    frames, clear, _ = camera.read_all([frame], [pupils], dark_files[0], pupil_dark_files=dark_files[1])
    np.testing.assert_allclose(frames[0].counts, image)
    np.testing.assert_allclose(clear[0].counts, FRAME)


def test_dark_that_does_not_fit_is_named(tmp_path):
    frame = write(tmp_path / "frame.fits", FRAME + 1.0, EXPTIME=2.0)
    dark = write(tmp_path / "dark.fits", 0.0 * FRAME, EXPTIME=1.0)
    with pytest.warns(UserWarning, match=r"EXPTIME is 1\.0 in dark\.fits and 2\.0 in frame\.fits"):
        camera.read_all([frame], [frame], [dark])
    noise = np.random.default_rng(1).normal(0, 2, (3, *FRAME.shape))
    noise[2] += 50
    darks = [write(tmp_path / f"dark{index}.fits", counts) for index, counts in enumerate(noise)]
    camera.read_all([frame], [frame], darks[:2])
    with pytest.raises(ValueError, match=r"dark2\.fits has .* counts more than dark0\.fits.*pupil_dark_files"):
        camera.read_all([frame], [frame], [darks[0], darks[2]])
    write(dark, FRAME[1:] + 0.0)
    with pytest.raises(ValueError, match=r"dark_files: dark\.fits has shape \(19, 30\): expected \(20, 30\)"):
        camera.read_all([frame], [frame], [dark])


def test_unit_of_a_file_is_chosen_or_asked_for(tmp_path):
    images = FRAME + 10.0, 0 * FRAME + 10.0, np.ones(FRAME.shape, int)
    path = write(tmp_path / "a.fits", *images, None, names=("DARK", "MASK", "FLAT"))
    for dark in (f"{path}[DARK]", f"{path}[1]"):
        (frame,), _, sources = camera.read_all([path], [path], [dark])
        np.testing.assert_allclose(frame.counts, FRAME)
        assert {source.path for source in sources} == {path.resolve()}
    asked = r"a\.fits: it has 3 image units, .*\[1\] DARK \(20, 30\) float64.* as 'a\.fits\[0\]'"
    with pytest.raises(camera.FileError, match=asked):
        camera.read(f"{path}[5]")
    for others in ([images], [[FRAME] * 3], [[FRAME, FRAME[1:]]], [[FRAME] * 2, ["PUPILS"]]):
        write(path, *others[0], names=others[-1][:1] if len(others) > 1 else ())
        with pytest.raises(
            camera.FileError, match=r"a\.fits: it has \d image units, \[0\] \(20, 30\) .*choose it"
        ):
            camera.read_all([path], [path])
    with pytest.raises(ValueError, match="is the input"):
        camera.check_output(path, [f"{path}[1]"], overwrite=True)


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.uint16, np.float32])
@pytest.mark.parametrize("algorithm", ["RICE_1", "GZIP_2"])
def test_compressed_images_are_read(tmp_path, dtype, algorithm):
    image = (FRAME + (40_000 if dtype == np.uint16 else 0)).astype(dtype)
    level = {"quantize_level": 0.0} if dtype == np.float32 else {}
    unit = fits.CompImageHDU(image, compression_type="GZIP_2" if level else algorithm, **level)
    fits.HDUList([fits.PrimaryHDU(), unit]).writeto(tmp_path / "a.fits")
    camera_file = camera.read(tmp_path / "a.fits")
    np.testing.assert_array_equal(camera_file.images[0], image)


def _tile(packed, n=20):
    """A file with one compressed tile that the header calls (n, n)."""
    data = np.array([np.frombuffer(packed, np.uint8)], object)
    table = fits.BinTableHDU.from_columns([fits.Column("COMPRESSED_DATA", "PB()", array=data)])
    cards = {"ZIMAGE": True, "ZCMPTYPE": "GZIP_1", "ZBITPIX": 16, "ZNAXIS": 2}
    table.header.update(cards | dict.fromkeys(("ZNAXIS1", "ZNAXIS2", "ZTILE1", "ZTILE2"), n))
    return fits_bytes(fits.PrimaryHDU(), table)


REFUSED = {
    "no picture": (lambda: b"not a picture", "its first bytes are those of neither a FITS nor an NPY file"),
    "pickle": (lambda: pickle.dumps(FRAME), "its first bytes are those of neither"),
    "objects": (lambda: npy_bytes(np.array([{}], dtype=object)), "a broken NPY file: .* Python objects"),
    "complex": (lambda: npy_bytes(FRAME + 1j), "its numbers are complex128"),
    "no image": (lambda: fits_bytes(fits.PrimaryHDU(), column("x")), "a FITS file without an image"),
    "too many": (lambda: fits_bytes(fits.PrimaryHDU(np.zeros((5, 20, 30)))), r"its shape is \(5, 20, 30\)"),
    "larger FITS than the file": (
        lambda: fits_bytes(fits.PrimaryHDU(FRAME)).replace(
            b"NAXIS2  =                   20", b"NAXIS2  =           9999999999"
        ),
        "truncated: it holds 5760 of the 2399999999760 bytes",
    ),
    "larger NPY than the file": (
        lambda: npy_bytes(FRAME).replace(b"(20, 30), }     ", b"(20, 9999999), }"),
        "a broken NPY file: .* greater than file size",
    ),
    "cut": (lambda: fits_bytes(fits.PrimaryHDU(FRAME))[:-4000], "truncated: it holds 1760 of the 4800 bytes"),
    "compressed bomb": (lambda: _tile(gzip.compress(bytes(700 << 20), 1)), ".* a compressed tile may unpack to"),
    "huge tile": (lambda: _tile(b"0", 99_999), ".* a compressed tile may unpack to 79998400008 bytes"),
    "missing tiles": (
        lambda: fits_bytes(fits.PrimaryHDU(), fits.CompImageHDU(FRAME.astype(np.int32))).replace(
            b"ZNAXIS2 =                   20", b"ZNAXIS2 =             99999999"
        ),
        ".* 20 compressed tiles: expected 99999999",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_file_is_refused_before_its_numbers_are_read(tmp_path, kind):
    content, message = REFUSED[kind]
    (tmp_path / "a.fits").write_bytes(content())
    tracemalloc.start()
    with pytest.raises(camera.FileError, match=rf"a\.fits: {message}"):
        camera.read(tmp_path / "a.fits")
    assert tracemalloc.get_traced_memory()[1] < 32 << 20
    tracemalloc.stop()


# Writing


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a camera frame, an earlier phase map, and a text; it is the current one."""
    monkeypatch.chdir(tmp_path)
    fits.PrimaryHDU(FRAME.astype(float)).writeto("frame.fits")
    fits.PrimaryHDU(FRAME.astype(float), fits.Header({"CREATOR": "zwfs 0.1"})).writeto("phase.fits")
    Path("notes.md").write_text("precious")
    Path("sub").mkdir()
    return tmp_path


def test_output_that_is_new_or_an_earlier_phase_map(folder):
    for name in ("new.fits", "deep/er/new.fits", "phase.fits", Path("sub/../phase.fits")):
        assert camera.check_output(name, ["frame.fits"]) == (folder / name).resolve()
    assert camera.check_output("notes.md", ["frame.fits"], overwrite=True) == folder / "notes.md"
    assert not (folder / "deep").exists()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("frame.fits", "exists and is not a phase map"),
        ("notes.md", "exists and is not a phase map"),
        ("link.md", "exists and is not a phase map"),
        ("sub", "expected a file, not a folder"),
        ("/dev/null", "expected a file, not a folder"),
        ("", "expected the name of a file"),
        ("notes.md/phase.fits", "expected a file in a folder"),
        ("x" * 250 + ".fits", "expected a name of at most 240 bytes"),
        ("circle", "output = 'circle'"),
        ("\ud800", "expected the name of a file"),
    ],
)
def test_output_that_would_lose_a_file_or_cannot_be_written(folder, name, message):
    (folder / "link.md").symlink_to("notes.md")
    (folder / "circle").symlink_to("circle")
    with pytest.raises(ValueError, match=f"output = .*{message}|{message}"):
        camera.check_output(name)
    assert (folder / "notes.md").read_text() == "precious"


def test_bench_files_replace_only_those_of_a_bench(tmp_path):
    bench = Bench(n_pixels=40, gap=0.02)
    before, after, again = (
        [path.read_bytes() for path in write_bench(tmp_path, bench, n_bad=10, seed=seed).values()]
        for seed in (1, 2, 2)
    )
    assert before != after == again
    fits.PrimaryHDU(FRAME).writeto(tmp_path / "dark.fits", overwrite=True)
    raw = (tmp_path / "dark.fits").read_bytes()
    with pytest.raises(ValueError, match=r"folder = .* holds a dark\.fits that the simulated bench did not write"):
        write_bench(tmp_path, bench, seed=3)
    assert (tmp_path / "dark.fits").read_bytes() == raw
    assert (tmp_path / "frame.fits").read_bytes() == after[0]
    with pytest.raises(ValueError, match=r"folder = .*nowhere'"):
        write_bench(tmp_path / "nowhere", bench)
